//! Writes parameters into a graph file: prepares the new text before anything changes, and replaces the file in one step.

use std::path::Path;

use anyhow::{Result, bail};
use carril_runtime::Registry;
use carril_runtime::graph::calibration::CalibrationText;
use carril_runtime::graph::{FileChange, Graph, ReadOptions, edit};
use carril_runtime::parameters::{shown, value_at};
use serde_json::{Map, Value};

use super::graph_file;

/// A graph file with the text that it shall have.
pub struct Prepared(FileChange);

impl Prepared {
    /// Puts values into the text of a file. Nothing is written yet. `effective` is the node's configuration with the values.
    pub fn new(
        path: &Path,
        node: &str,
        values: &Map<String, Value>,
        effective: &Value,
        registry: &Registry,
    ) -> Result<Self> {
        let change = FileChange::prepare(path, |text| edit(text, node, values, effective))?;
        match Graph::parse(change.after().to_owned(), change.path(), registry, &ReadOptions::default()) {
            Ok(graph) => must_hold(&graph, change.after(), node, values, registry)?,
            Err(problems) => {
                let problems = graph_file::render(&problems, false);
                bail!("not saved: with these values the file would not pass `carril check`:\n{problems}");
            }
        }
        Ok(Self(change))
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.0.path()
    }

    /// Replaces the file in one step; its mode stays. Refused when somebody else has changed it meanwhile.
    pub fn save(&self) -> Result<()> {
        Ok(self.0.save()?)
    }
}

/// A value that the calibration file gives too would not be in force at the next start.
fn must_hold(graph: &Graph, text: &str, node: &str, values: &Map<String, Value>, registry: &Registry) -> Result<()> {
    let Some(file) = &graph.calibration else { return Ok(()) };
    let none = CalibrationText { path: file.clone(), text: String::new() };
    let options = ReadOptions { calibration: Some(none), ..ReadOptions::default() };
    // Without the calibration a value may be missing; then it is not this one that matters.
    let Ok(bare) = Graph::parse(text.to_owned(), &graph.path, registry, &options) else { return Ok(()) };
    let (Some(held), Some(bare)) = (graph.node(node), bare.node(node)) else { return Ok(()) };
    for path in values.keys() {
        let held = value_at(&held.config, path);
        if held != value_at(&bare.config, path) {
            let (file, held) = (file.display(), held.map(shown).unwrap_or_default());
            bail!(
                "not saved: `{node}.{path}` is {held} in the calibration file `{file}`, which goes over the graph file\n\
                 hint: change it there, or find it anew with `carril calibrate`"
            );
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    use serde_json::json;

    use super::*;
    use crate::common::registry::built_in;

    const FILE: &str = "robot: car1\nnodes:\n  world: { operator: sim-world }\n  mcu: { operator: sim-mcu, config: { line: mcu }, inputs: { sensors: world/sensors } }   # the chip\n";

    fn values(battery_low_v: Value) -> Map<String, Value> {
        Map::from_iter([("battery_low_v".to_owned(), battery_low_v)])
    }

    #[test]
    fn saves_in_one_step_and_keeps_mode_and_link() {
        let folder = tempfile::tempdir().expect("a folder");
        let (real, link) = (folder.path().join("real.yaml"), folder.path().join("link.yaml"));
        fs::write(&real, FILE).expect("it is writable");
        fs::set_permissions(&real, fs::Permissions::from_mode(0o640)).expect("it is ours");
        std::os::unix::fs::symlink(&real, &link).expect("links can be made");
        let prepared = Prepared::new(&link, "mcu", &values(json!(6)), &Value::Null, &built_in()).expect("it can");
        assert_eq!(fs::read_to_string(&real).expect("text"), FILE, "nothing is written yet");
        prepared.save().expect("it can be written");
        let expected = FILE.replace("line: mcu", "line: mcu, battery_low_v: 6");
        assert_eq!(fs::read_to_string(&real).expect("text"), expected, "one value more");
        assert_eq!(fs::metadata(&real).expect("there").permissions().mode() & 0o777, 0o640, "the mode");
        assert!(link.is_symlink(), "the link");
        assert_eq!(fs::read_dir(folder.path()).expect("there").count(), 2, "nothing is left over");
    }

    #[test]
    fn refuses_what_would_not_pass_the_check_and_what_changed_meanwhile() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("a.yaml");
        fs::write(&file, FILE).expect("it is writable");
        let error = Prepared::new(&file, "mcu", &values(json!(-1)), &Value::Null, &built_in()).err().expect("refused");
        assert!(error.to_string().contains("would not pass `carril check`"), "{error}");
        let prepared = Prepared::new(&file, "mcu", &values(json!(6)), &Value::Null, &built_in()).expect("it can");
        fs::write(&file, format!("{FILE}# more\n")).expect("it is writable");
        let error = prepared.save().expect_err("refused").to_string();
        assert!(error.contains("somebody has changed"), "{error}");
        assert_eq!(fs::read_to_string(&file).expect("text"), format!("{FILE}# more\n"), "untouched");
    }

    #[test]
    fn a_value_that_the_calibration_file_gives_is_not_saved_where_it_has_no_effect() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("a.yaml");
        let calibrated = format!("calibration: car.yaml\n{FILE}");
        fs::write(&file, &calibrated).expect("it is writable");
        fs::write(folder.path().join("car.yaml"), "nodes: { mcu: { battery_low_v: 6.5 } }").expect("it is writable");
        let error = Prepared::new(&file, "mcu", &values(json!(6)), &Value::Null, &built_in()).err().expect("refused");
        assert!(error.to_string().contains("is 6.5 in the calibration file"), "{error}");
        assert_eq!(fs::read_to_string(&file).expect("text"), calibrated, "untouched");
        fs::remove_file(folder.path().join("car.yaml")).expect("it was there");
        Prepared::new(&file, "mcu", &values(json!(6)), &Value::Null, &built_in()).expect("nothing is calibrated");
    }
}
