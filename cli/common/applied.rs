//! The plan and the receipt of a change of the whole graph, for people.

use std::fmt::Write as _;
use std::path::Path;

use carril_runtime::control_plane::{Action, ApplyReceipt, Difference, NodeChange, Outcome};

use super::{output, receipt};

/// What is to be done, as a diff.
pub fn plan(plan: &ApplyReceipt, robot: &str, file: &Path) -> String {
    let file = file.display();
    if plan.changes.is_empty() && plan.reason.is_none() {
        return format!("{robot} runs just as {file} says; nothing is to be done");
    }
    let mut text = format!("From the running graph of {robot} to {file}:");
    for change in &plan.changes {
        text.push_str(&node(change));
    }
    if !plan.unchanged.is_empty() {
        let stay = output::counted(plan.unchanged.len() as u64, "node");
        // Writing to a string cannot fail.
        let _ = write!(text, "\n  {stay} left alone: {}", plan.unchanged.join(", "));
    }
    text.push_str(&why(plan));
    text
}

fn node(change: &NodeChange) -> String {
    let sign = match change.actions.as_slice() {
        [Action::Add] => '+',
        [Action::Remove] => '-',
        _ => '~',
    };
    let actions = change.actions.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    let differences: String = change.differences.iter().map(difference).collect();
    format!("\n{sign} {:<14} {actions}{differences}", change.node)
}

fn difference(difference: &Difference) -> String {
    let line = |sign: char, value: &Option<String>| {
        value.as_ref().map(|value| format!("\n    {sign} {}: {value}", difference.what)).unwrap_or_default()
    };
    line('-', &difference.before) + &line('+', &difference.after)
}

/// What came of it.
pub fn receipt(applied: &ApplyReceipt) -> String {
    let steps: String = applied.steps.iter().map(|step| receipt::text(step) + "\n").collect();
    steps + &headline(applied)
}

/// What came of it, without its steps.
pub fn headline(applied: &ApplyReceipt) -> String {
    let nodes = output::counted(applied.changes.len() as u64, "node");
    let headline = match applied.outcome {
        Outcome::Done => format!("apply done: {nodes} changed in {:.1} ms", applied.took_ms),
        Outcome::RolledBack => "apply undone: every node is as it was before".to_owned(),
        _ => "apply refused, nothing has changed".to_owned(),
    };
    headline + &why(applied)
}

fn why(applied: &ApplyReceipt) -> String {
    let Some(reason) = &applied.reason else { return String::new() };
    let node = applied.node.as_ref().map(|node| format!("node `{node}`: ")).unwrap_or_default();
    let phase = applied.phase.as_deref().unwrap_or("request");
    format!("\n  why           {node}{reason} (phase: {phase})")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change(node: &str, action: Action, before: Option<&str>, after: Option<&str>) -> NodeChange {
        let (before, after) = (before.map(str::to_owned), after.map(str::to_owned));
        let differences = vec![Difference { what: "inputs.lane".into(), before, after }];
        NodeChange { node: node.into(), actions: vec![action], differences }
    }

    #[test]
    fn a_plan_reads_like_a_diff() {
        let changes = vec![
            change("smooth", Action::Add, None, Some("lane/lane")),
            change("decision", Action::Rewire, Some("lane/lane"), Some("smooth/estimate")),
            change("old", Action::Remove, Some("lane/lane"), None),
        ];
        let unchanged = vec!["lane".into(), "world".into()];
        let text = plan(&ApplyReceipt { changes, unchanged, ..ApplyReceipt::default() }, "car1", Path::new("a.yaml"));
        let expected = "From the running graph of car1 to a.yaml:
+ smooth         add
    + inputs.lane: lane/lane
~ decision       rewire
    - inputs.lane: lane/lane
    + inputs.lane: smooth/estimate
- old            remove
    - inputs.lane: lane/lane
  2 nodes left alone: lane, world";
        assert_eq!(text, expected, "signs, old and new lines, what stays");
    }

    #[test]
    fn a_failure_names_the_node_the_phase_and_the_reason() {
        let applied = ApplyReceipt {
            outcome: Outcome::RolledBack,
            node: Some("lane".into()),
            phase: Some("probation".into()),
            reason: Some("a step panicked: no".into()),
            ..ApplyReceipt::default()
        };
        let text = receipt(&applied);
        assert!(text.starts_with("apply undone"), "the headline: {text}");
        assert!(text.contains("node `lane`: a step panicked: no (phase: probation)"), "the reason: {text}");
    }
}
