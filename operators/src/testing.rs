//! What the tests of several operators share. Compiled for tests only.

use std::path::Path;

use carril_messages::{Header, Message, Meta, Origins, SourceId, Stamp};
use carril_runtime::{Context, Findings, HeapPool, Operator, OperatorConfig, OperatorKind, Trigger};
use serde_json::Value;

/// What is wrong with a configuration, as `field: message`.
pub fn problems<O: Operator>(config: &Value) -> Vec<String> {
    let found = OperatorKind::of::<O>().check_config(config, Path::new("."), false);
    found.into_iter().map(|finding| format!("{}: {}", finding.path.join("."), finding.message)).collect()
}

/// The fields in which a configuration that never was YAML is wrong.
pub fn fields_found(config: &impl OperatorConfig) -> Vec<String> {
    let mut findings = Findings::new(Path::new("."), false);
    config.check(&mut findings);
    findings.into_found().into_iter().map(|finding| finding.path.join(".")).collect()
}

/// A point in time, ms after the start.
pub fn at_ms(ms: i64) -> Stamp {
    Stamp::from_nanos(ms * 1_000_000)
}

/// A header of a sample that was captured and published at `stamp`.
pub fn header<T: Message>(stamp: Stamp) -> Header {
    let origins = Origins::captured(SourceId::of("world", "sensor"), stamp);
    Header { epoch: 1, seq: 0, stamp, origins, message_type: T::TYPE, meta: Meta::new() }
}

/// The context of a step at `now`.
pub fn context(now: Stamp, trigger: Trigger) -> Context<'static> {
    Context::new(now, trigger, &HeapPool)
}
