//! The rules of a graph file. Each is one small function that reads the draft and reports; none changes anything.

mod body;
mod budgets;
mod config;
mod cycles;
mod inputs;
mod machines;
mod names;
mod process;
mod ranges;
mod remote;
mod timing;
mod types;
mod way;

use super::draft::{Draft, Report};

type Rule = fn(&Draft<'_>, &mut Report<'_>);

const RULES: &[Rule] = &[
    names::valid_names,
    names::unique_keys,
    body::operator_or_exec,
    body::known_operator,
    body::binary_tells_its_operator,
    config::valid_config,
    inputs::known_outputs,
    inputs::known_inputs,
    inputs::required_inputs_connected,
    types::same_types,
    cycles::cycles_have_a_delay,
    ranges::numbers_in_range,
    ranges::restart_makes_sense,
    process::one_setting_per_process,
    timing::steps_fit,
    timing::samples_stay_fresh,
    timing::settings_have_an_effect,
    budgets::budgets_reach,
    budgets::budgets_hold,
    remote::remote_makes_sense,
    machines::machine_of_this_graph,
    machines::machines_can_join,
    machines::safety_stays_on_the_car,
    machines::links_keep_the_newest_only,
    machines::what_is_not_checked_here,
];

/// Applies every rule.
pub(crate) fn check(draft: &Draft<'_>, report: &mut Report<'_>) {
    for rule in RULES {
        rule(draft, report);
    }
}
