//! A scenario without anything that varies, as the text of a file: what shrinking leaves.

use std::path::{Component, Path, PathBuf};

use anyhow::{Context, Result};
use carril_runtime::scenario::{Amount, Scenario};
use serde_json::{Map, Value};

/// The text of a file at `path`. `comments` come first, a line each.
pub fn text(scenario: &Scenario, path: &Path, comments: &[String]) -> Result<String> {
    let mut lines: Vec<String> =
        comments.iter().map(|comment| format!("# {}", comment.replace(['\n', '\r'], " "))).collect();
    let graph = relative(&scenario.graph, path)?.display().to_string();
    lines.push(format!("graph: {}", Value::from(graph)));
    lines.push(format!("seconds: {}", scenario.seconds));
    let heads = [("laps", scenario.laps.map(u64::from)), ("seed", scenario.seed)];
    lines.extend(heads.iter().filter_map(|(key, number)| Some(format!("{key}: {}", (*number)?))));
    let latency = scenario.latency.iter().filter_map(|(node, ms)| match ms {
        Amount::Fixed(ms) => Some((node.clone(), Value::from(*ms))),
        Amount::Drawn(_) => None,
    });
    let success = serde_json::to_value(&scenario.success).context("what counts as success cannot be written")?;
    lines.extend(section("set", scenario.set.iter().cloned()));
    lines.extend(section("latency", latency));
    lines.extend(section("success", success.as_object().cloned().unwrap_or_else(Map::new)));
    Ok(lines.join("\n") + "\n")
}

/// Values as JSON, which YAML reads too.
fn section(name: &str, entries: impl IntoIterator<Item = (String, Value)>) -> Vec<String> {
    let lines: Vec<String> = entries.into_iter().map(|(key, value)| format!("  {key}: {value}")).collect();
    if lines.is_empty() { lines } else { std::iter::once(format!("{name}:")).chain(lines).collect() }
}

/// The way from the folder of `file`, which need not be there yet, to `target`.
fn relative(target: &Path, file: &Path) -> Result<PathBuf> {
    let real = |path: &Path| path.canonicalize().with_context(|| format!("cannot find `{}`", path.display()));
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let (target, folder) = (real(target)?, real(folder)?);
    let shared = target.components().zip(folder.components()).take_while(|(a, b)| a == b).count();
    // Nothing but the root in common: such a path is better told from there.
    if shared <= 1 {
        return Ok(target);
    }
    let up = folder.components().skip(shared).map(|_| Component::ParentDir);
    Ok(up.chain(target.components().skip(shared)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_graph_is_found_from_the_folder_of_the_new_file() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["graphs", "scenarios/deep"] {
            std::fs::create_dir_all(folder.path().join(name)).expect("made");
        }
        std::fs::write(folder.path().join("graphs/g.yaml"), "").expect("written");
        let graph = folder.path().join("scenarios/../graphs/g.yaml");
        let from = |file: &str| relative(&graph, &folder.path().join(file)).expect("both are there");
        assert_eq!(from("scenarios/deep/new.yaml"), Path::new("../../graphs/g.yaml"), "up and down");
        assert_eq!(from("graphs/new.yaml"), Path::new("g.yaml"), "beside it");
        assert!(relative(&graph, &folder.path().join("no/new.yaml")).is_err(), "a folder that is not there");
    }
}
