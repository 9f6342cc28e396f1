//! Binaries of the user's own (`exec:`): each is asked once what its operators are, and each node takes one of them.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::suggest;
use crate::describe::{self, DescribeError, Description, OperatorDescription};
use crate::registry::OperatorKind;

/// Why the operator of a binary cannot be told, in the words of a problem of the graph.
#[derive(Clone, Debug)]
pub(crate) struct Refusal {
    /// Which key of the node is wrong: `exec` or `operator`.
    pub(crate) key: &'static str,
    pub(crate) rule: &'static str,
    /// Begins with the path of the binary.
    pub(crate) message: String,
    pub(crate) hint: Option<String>,
}

/// The binaries of a graph file.
pub(crate) struct Binaries<'a> {
    base_dir: &'a Path,
    asked: HashMap<PathBuf, Result<Description, Refusal>>,
}

impl<'a> Binaries<'a> {
    pub(crate) fn new(base_dir: &'a Path) -> Self {
        Self { base_dir, asked: HashMap::new() }
    }

    /// The operator for a node: the one that it names with `operator`, else the one named like the node, else the only one.
    pub(crate) fn operator(
        &mut self,
        exec: &str,
        operator: Option<&str>,
        node: &str,
    ) -> Result<(PathBuf, Arc<OperatorKind>), Refusal> {
        let path = self.base_dir.join(exec);
        let asked =
            self.asked.entry(path).or_insert_with_key(|path| describe::ask(path).map_err(|error| refusal(&error)));
        let description = asked.as_ref().map_err(Clone::clone)?;
        let path = self.base_dir.join(exec);
        let operator = choose(&path, description, operator, node)?;
        let kind = describe::kind_of(&path, operator, self.base_dir);
        Ok((path, Arc::new(kind)))
    }
}

/// Asks a binary that shall run in `node` which operator that is. `Err` says why that cannot be told, and what to do.
#[cfg(feature = "live")]
pub(crate) fn operator_in(path: &Path, node: &str) -> Result<OperatorDescription, String> {
    let chosen = describe::ask(path)
        .map_err(|error| refusal(&error))
        .and_then(|description| choose(path, &description, None, node).cloned());
    chosen.map_err(|refusal| match refusal.hint {
        Some(hint) => format!("{} ({hint})", refusal.message),
        None => refusal.message,
    })
}

fn refusal(error: &DescribeError) -> Refusal {
    let rule = if error.is_missing() { "missing-executable" } else { "no-description" };
    Refusal { key: "exec", rule, message: error.to_string(), hint: Some(error.hint()) }
}

fn choose<'d>(
    path: &Path,
    description: &'d Description,
    named: Option<&str>,
    node: &str,
) -> Result<&'d OperatorDescription, Refusal> {
    let operators = &description.operators;
    let names = || operators.iter().map(|operator| operator.name.as_str());
    let find = |name: &str| operators.iter().find(|operator| operator.name == name);
    if let Some(named) = named {
        return find(named).ok_or_else(|| Refusal {
            key: "operator",
            rule: "unknown-operator",
            message: format!("`{}` has no operator `{}`", path.display(), suggest::shorten(named)),
            hint: suggest::hint(named, names()),
        });
    }
    match &operators[..] {
        [only] => Ok(only),
        several => find(node).ok_or_else(|| {
            let list = suggest::list(names()).unwrap_or_default();
            Refusal {
                key: "exec",
                rule: "several-operators",
                message: format!("`{}` has several operators: {list}", path.display()),
                hint: Some(format!("say which: `operator: {}`, beside `exec`", several[0].name)),
            }
        }),
    }
}
