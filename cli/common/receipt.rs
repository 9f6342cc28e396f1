//! The receipt of a change, for people.

use std::fmt::Write as _;

use carril_messages::Percentiles;
use carril_runtime::control_plane::{Outcome, Receipt};

/// A receipt as lines of text.
pub fn text(receipt: &Receipt) -> String {
    let mut text = headline(receipt);
    for (name, value) in rows(receipt) {
        // Writing to a string cannot fail.
        let _ = write!(text, "\n  {name:<14}{value}");
    }
    text
}

fn headline(receipt: &Receipt) -> String {
    let Receipt { node, what, .. } = receipt;
    match (receipt.outcome, receipt.took_ms) {
        (Outcome::Done, Some(ms)) => format!("{node}: {what} done, in force after {ms:.1} ms"),
        (Outcome::Done, None) => format!("{node}: {what} done"),
        (Outcome::Planned, _) => format!("{node}: {what} planned"),
        (Outcome::Compared, _) => format!("{node}: compared, nothing was taken over"),
        (Outcome::Refused, _) => format!("{node}: {what} refused, nothing has changed"),
        (Outcome::RolledBack, _) => format!("{node}: {what} rolled back, the version before goes on"),
    }
}

fn rows(receipt: &Receipt) -> Vec<(&'static str, String)> {
    let mut rows = vec![("from", receipt.from.clone()), ("to", receipt.to.clone())];
    // A node that is new was nothing before.
    rows.retain(|(_, version)| !version.is_empty());
    if let Some(reason) = &receipt.reason {
        let phase = receipt.phase.as_deref().unwrap_or("request");
        rows.push(("why", format!("{reason} (phase: {phase})")));
    }
    if let (Some(gap), Some(usual)) = (receipt.gap_ms, receipt.usual_gap_ms) {
        rows.push(("longest pause", format!("{gap:.1} ms between two outputs; usual {usual:.1} ms")));
        rows.push(("samples", samples(receipt)));
    }
    if let (Some(bytes), Some((from, to))) = (receipt.state_bytes, receipt.state_versions) {
        rows.push(("state", format!("{bytes} B, version {from} -> {to}")));
    }
    if let Some(after) = receipt.latency_after_us {
        let before = receipt.latency_before_us.map_or_else(|| "not known".to_owned(), latency);
        rows.push(("latency", format!("{before} -> {}", latency(after))));
    }
    if receipt.compared > 0 {
        let largest = receipt.largest_difference.as_ref();
        let largest =
            largest.map_or("all alike".to_owned(), |(field, by)| format!("largest difference {by:.4} in {field}"));
        rows.push(("shadow", format!("{} outputs compared; {largest}", receipt.compared)));
    }
    rows
}

fn samples(receipt: &Receipt) -> String {
    format!("{} queued, {} lost, {} duplicated", receipt.queued, receipt.lost, receipt.duplicated)
}

fn latency(latency: Percentiles) -> String {
    format!("p50 {:.0} us, p99 {:.0} us", latency.p50, latency.p99)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn says_what_happened_and_why_not() {
        let receipt = Receipt {
            node: "lane".into(),
            what: "swap".into(),
            outcome: Outcome::RolledBack,
            phase: Some("probation".into()),
            reason: Some("a step panicked: no".into()),
            ..Receipt::default()
        };
        let text = text(&receipt);
        assert!(text.starts_with("lane: swap rolled back"), "the headline: {text}");
        assert!(text.contains("a step panicked: no (phase: probation)"), "the reason: {text}");
    }
}
