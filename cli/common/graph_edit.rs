//! Writes parameters into a graph file: prepares the new text before anything changes, and replaces the file in one step.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use carril_runtime::Registry;
use carril_runtime::graph::{Graph, ReadOptions, edit};
use serde_json::{Map, Value};

use super::graph_file;

/// A graph file with the text that it shall have.
pub struct Prepared {
    path: PathBuf,
    before: String,
    after: String,
}

impl Prepared {
    /// Puts values into the text of a file. Nothing is written yet. `effective` is the node's configuration with the values.
    pub fn new(
        path: &Path,
        node: &str,
        values: &Map<String, Value>,
        effective: &Value,
        registry: &Registry,
    ) -> Result<Self> {
        // A link stays a link.
        let path = fs::canonicalize(path).with_context(|| format!("cannot find `{}`", path.display()))?;
        let before = fs::read_to_string(&path).with_context(|| format!("cannot read `{}`", path.display()))?;
        let after = edit(&before, node, values, effective).with_context(|| format!("not saved: {}", path.display()))?;
        if let Err(problems) = Graph::parse(after.clone(), &path, registry, &ReadOptions::default()) {
            let problems = graph_file::render(&problems, false);
            bail!("not saved: with these values the file would not pass `carril check`:\n{problems}");
        }
        Ok(Self { path, before, after })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Replaces the file in one step; its mode stays. Refused when somebody else has changed it meanwhile.
    pub fn save(&self) -> Result<()> {
        let shown = self.path.display();
        let now = fs::read_to_string(&self.path).with_context(|| format!("cannot read `{shown}`"))?;
        if now != self.before {
            bail!("not saved: somebody has changed `{shown}` meanwhile; repeat the command");
        }
        if self.after == self.before {
            return Ok(());
        }
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let fresh = self.path.with_file_name(format!(".{name}.{}", std::process::id()));
        let written = self.write(&fresh).and_then(|()| fs::rename(&fresh, &self.path));
        if written.is_err() {
            // It may not even have been made.
            let _ = fs::remove_file(&fresh);
        }
        written.with_context(|| format!("not saved: cannot write `{shown}`"))
    }

    fn write(&self, fresh: &Path) -> std::io::Result<()> {
        let mut file = OpenOptions::new().write(true).create_new(true).open(fresh)?;
        file.set_permissions(fs::metadata(&self.path)?.permissions())?;
        file.write_all(self.after.as_bytes())?;
        file.sync_all()
    }
}

#[cfg(test)]
mod tests {
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
}
