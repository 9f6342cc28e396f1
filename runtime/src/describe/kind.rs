//! A kind of operator that is in a binary of its own: known by its description, its configuration judged by the binary itself.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde_json::Value;

use super::{ConfigAnswer, ConfigQuestion, FORMAT, OperatorDescription, ask_config};
use crate::config::Finding;
use crate::operator::SetupError;
use crate::registry::{Behaviour, ErasedOperator, OperatorKind};
use crate::setup::Setup;

/// So many answers are kept: a graph is checked with few configurations of one node.
const KEPT: usize = 32;

/// The kind that `program` described. `base_dir` is the folder of the graph file.
pub(crate) fn kind_of(program: &Path, operator: &OperatorDescription, base_dir: &Path) -> OperatorKind {
    let behaviour = InBinary {
        program: program.to_owned(),
        kind: operator.name.clone(),
        base_dir: base_dir.to_owned(),
        config_schema: operator.config_schema.clone(),
        answers: Mutex::default(),
    };
    OperatorKind::described(operator, Arc::new(behaviour))
}

struct InBinary {
    program: PathBuf,
    kind: String,
    base_dir: PathBuf,
    config_schema: Value,
    /// So that checking a graph asks once per configuration.
    answers: Mutex<Vec<(ConfigQuestion, ConfigAnswer)>>,
}

impl InBinary {
    fn answer(&self, config: &Value, base_dir: &Path, probe_devices: bool) -> ConfigAnswer {
        let (kind, config, base_dir) = (self.kind.clone(), config.clone(), base_dir.to_owned());
        let question = ConfigQuestion { kind, config, base_dir, probe_devices };
        let mut answers = self.answers.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, answer)) = answers.iter().find(|(asked, _)| *asked == question) {
            return answer.clone();
        }
        let answer = ask_config(&self.program, &question).unwrap_or_else(|error| {
            let (message, hint) = (error.to_string(), Some(error.hint()));
            let finding = Finding { path: Vec::new(), message, hint, missing_file: false };
            ConfigAnswer {
                format: FORMAT,
                shape: None,
                findings: vec![finding],
                period_ns: None,
                exclusive: false,
                effective: question.config.clone(),
            }
        });
        if answers.len() >= KEPT {
            answers.remove(0);
        }
        answers.push((question, answer.clone()));
        answer
    }

    /// What depends on nothing but the configuration.
    fn plain_answer(&self, config: &Value) -> ConfigAnswer {
        self.answer(config, &self.base_dir, false)
    }
}

impl Behaviour for InBinary {
    fn config_schema(&self) -> Value {
        self.config_schema.clone()
    }

    fn check_config(&self, config: &Value, base_dir: &Path, probe_devices: bool) -> Vec<Finding> {
        self.answer(config, base_dir, probe_devices).findings
    }

    fn check_shape(&self, config: &Value) -> Option<Finding> {
        self.plain_answer(config).shape
    }

    fn period(&self, config: &Value) -> Option<Duration> {
        self.plain_answer(config).period_ns.map(Duration::from_nanos)
    }

    fn exclusive(&self, config: &Value) -> bool {
        self.plain_answer(config).exclusive
    }

    fn effective_config(&self, config: &Value) -> Value {
        match self.plain_answer(config).effective {
            Value::Null => config.clone(),
            effective => effective,
        }
    }

    fn build(&self, _config: Value, _setup: &Setup) -> Result<Box<dyn ErasedOperator>, SetupError> {
        Err(SetupError::new(format!("`{}` runs only in its own binary, `{}`", self.kind, self.program.display())))
    }
}
