//! What a program says of the operators in it: `PROGRAM --describe` prints one JSON document, `PROGRAM --check-config` judges a
//! configuration. So the graph checker knows a binary of the user's own (`exec:`) as well as the operators built in.
//!
//! Asking runs the program. It has [`PATIENCE`] and [`MAX_OUTPUT_BYTES`]; whatever else it does comes back as a [`DescribeError`].

mod answer;
mod ask;
mod error;
mod kind;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use answer::answer;
pub use ask::{MAX_OUTPUT_BYTES, PATIENCE, ask, ask_config};
pub use error::DescribeError;
pub(crate) use kind::kind_of;

use crate::config::Finding;
use crate::ports::{InputSpec, OutputSpec};
use crate::registry::{OperatorKind, Registry};

/// Version of both documents. Raised when an older reader would misunderstand a newer document.
pub const FORMAT: u32 = 1;
/// The argument that asks for a [`Description`].
pub const DESCRIBE: &str = "--describe";
/// The argument that asks for a [`ConfigAnswer`]; the [`ConfigQuestion`] comes on standard input.
pub const CHECK_CONFIG: &str = "--check-config";

/// What a program says of itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// [`FORMAT`]
    pub format: u32,
    /// Version of carril that the program was built with.
    pub carril: String,
    /// Its kinds of operators, by name.
    pub operators: Vec<OperatorDescription>,
}

/// One kind of operator in a program.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OperatorDescription {
    /// Name of the kind.
    pub name: String,
    /// One line on what it does.
    pub summary: String,
    /// Input ports, in order.
    pub inputs: Vec<InputSpec>,
    /// Output ports, in order.
    pub outputs: Vec<OutputSpec>,
    /// [`OperatorKind::state_name`]; nothing: the name of the operator.
    #[serde(default)]
    pub state_name: String,
    /// Version of its state.
    pub state_version: u32,
    /// [`OperatorKind::stays_on_car`]
    #[serde(default)]
    pub stays_on_car: bool,
    /// JSON Schema of its configuration.
    pub config_schema: Value,
    /// Whether every value of its configuration has a default.
    pub has_defaults: bool,
}

/// Asks about a configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConfigQuestion {
    /// Name of the kind.
    pub kind: String,
    /// The configuration; `null`: none.
    #[serde(default)]
    pub config: Value,
    /// Where relative paths begin.
    pub base_dir: PathBuf,
    /// Whether devices must be there.
    #[serde(default)]
    pub probe_devices: bool,
}

/// What a program says of a configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ConfigAnswer {
    /// [`FORMAT`]
    pub format: u32,
    /// [`OperatorKind::check_shape`]
    pub shape: Option<Finding>,
    /// [`OperatorKind::check_config`]
    pub findings: Vec<Finding>,
    /// [`OperatorKind::period`], ns.
    pub period_ns: Option<u64>,
    /// [`OperatorKind::exclusive`]
    pub exclusive: bool,
    /// [`OperatorKind::effective_config`]; nothing: the configuration as it is.
    #[serde(default)]
    pub effective: Value,
}

/// What a program with these operators says of itself.
pub fn of(registry: &Registry) -> Description {
    let operators = registry.iter().map(|kind| OperatorDescription::of(kind)).collect();
    Description { format: FORMAT, carril: env!("CARGO_PKG_VERSION").to_owned(), operators }
}

impl OperatorDescription {
    /// What a kind says of itself.
    pub fn of(kind: &OperatorKind) -> Self {
        Self {
            name: kind.name.to_owned(),
            summary: kind.summary.to_owned(),
            inputs: kind.inputs.clone(),
            outputs: kind.outputs.clone(),
            state_name: kind.state_name.to_owned(),
            state_version: kind.state_version,
            stays_on_car: kind.stays_on_car,
            config_schema: kind.config_schema(),
            has_defaults: kind.check_shape(&Value::Null).is_none(),
        }
    }
}

impl ConfigAnswer {
    fn of(kind: &OperatorKind, question: &ConfigQuestion) -> Self {
        let config = &question.config;
        Self {
            format: FORMAT,
            shape: kind.check_shape(config),
            findings: kind.check_config(config, &question.base_dir, question.probe_devices),
            period_ns: kind.period(config).and_then(|period| u64::try_from(period.as_nanos()).ok()),
            exclusive: kind.exclusive(config),
            effective: kind.effective_config(config),
        }
    }
}
