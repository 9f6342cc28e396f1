//! The configuration of an operator: a typed struct, read from the graph file and checked before anything starts.

use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// The configuration of an operator.
///
/// Derive `Serialize`, `Deserialize` with `#[serde(default, deny_unknown_fields)]` where there are defaults, and `JsonSchema`.
/// The doc comments become the help text; `#[schemars(range(min = 0, max = 255), extend("unit" = "px"))]` tells people and tools
/// what may be set (a lower bound that does not belong to the range: `"exclusiveMinimum" = 0` in `extend`; no unit: `""`).
/// Write ranges in `check` so that NaN fails: `v > 0.0 && v <= max`.
pub trait OperatorConfig: Serialize + DeserializeOwned + JsonSchema + Send + 'static {
    /// Reports every value out of range, every file that must exist and every device that must be there.
    fn check(&self, findings: &mut Findings<'_>);
}

/// One thing wrong with a configuration.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// Path of the value below `config`: `["sectors", "2", "from_deg"]`. Empty: the configuration as a whole.
    pub path: Vec<String>,
    /// What we got and what is allowed: "got 300, allowed is 0 to 255".
    pub message: String,
    /// What to do, if there is more to say.
    pub hint: Option<String>,
    /// A file or folder is not on this machine: no matter where the operator runs on another one.
    #[serde(default)]
    pub missing_file: bool,
}

/// Collects what is wrong with a configuration, and what it needs from the machine.
pub struct Findings<'a> {
    base_dir: &'a Path,
    probe_devices: bool,
    found: Vec<Finding>,
    files: Vec<PathBuf>,
}

impl<'a> Findings<'a> {
    /// `base_dir` is the folder of the graph file: relative paths begin there. `probe_devices` is `check --devices`.
    pub fn new(base_dir: &'a Path, probe_devices: bool) -> Self {
        Self { base_dir, probe_devices, found: Vec::new(), files: Vec::new() }
    }

    /// Reports `field` unless `ok`. `field` is a path with dots: `sectors.2.from_deg`.
    pub fn require(&mut self, ok: bool, field: &str, message: impl FnOnce() -> String) {
        if !ok {
            self.report(field, message(), None);
        }
    }

    /// Reports `field`, with a hint what to do.
    pub fn report(&mut self, field: &str, message: String, hint: Option<String>) {
        let path = field.split('.').filter(|part| !part.is_empty()).map(str::to_owned).collect();
        self.found.push(Finding { path, message, hint, missing_file: false });
    }

    /// Reports `field` unless `min <= value <= max`. NaN is reported.
    pub fn range(&mut self, field: &str, value: f64, min: f64, max: f64, unit: &str) {
        let space = if unit.is_empty() { "" } else { " " };
        self.require(value >= min && value <= max, field, || {
            format!("got {value}{space}{unit}, allowed is {min} to {max}{space}{unit}")
        });
    }

    /// Reports `field` unless the file or folder is there. Relative paths begin at the graph file's folder.
    pub fn file(&mut self, field: &str, path: &str) {
        let full = self.base_dir.join(path);
        if full.exists() {
            self.files.push(full);
        } else {
            let hint = "paths begin at the folder of the graph file".to_owned();
            self.report(field, format!("`{}` does not exist", full.display()), Some(hint));
            self.found.last_mut().expect("it was just put there").missing_file = true;
        }
    }

    /// Reports `field` unless the device is there; only when devices are probed (`check --devices`). Relative paths begin at the graph
    /// file's folder.
    pub fn device(&mut self, field: &str, path: &str) {
        if self.probe_devices && !self.base_dir.join(path).exists() {
            let hint = "plug it in, or see `ls /dev/video* /dev/serial/by-id`".to_owned();
            self.report(field, format!("no device at `{path}`"), Some(hint));
        }
    }

    /// The folder of the graph file.
    pub fn base_dir(&self) -> &Path {
        self.base_dir
    }

    /// Whether devices are probed.
    pub fn probe_devices(&self) -> bool {
        self.probe_devices
    }

    /// What was found.
    pub fn into_found(self) -> Vec<Finding> {
        self.found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_refuses_nan() {
        let mut findings = Findings::new(Path::new("."), false);
        findings.range("threshold", f64::NAN, 0.0, 255.0, "");
        findings.range("rows.far", 0.5, 0.0, 1.0, "");
        let found = findings.into_found();
        assert_eq!(found.len(), 1, "only the NaN: {found:?}");
        assert_eq!(found[0].message, "got NaN, allowed is 0 to 255", "the message says both");
    }
}
