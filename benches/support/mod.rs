//! What the benchmarks share.

pub mod ages;
pub mod car;
pub mod children;
pub mod measure;
pub mod nodes;
#[path = "../../tests/support/page.rs"]
#[allow(dead_code, reason = "tests want more of a page than benchmarks")]
pub mod page;
pub mod plain;
pub mod report;
pub mod viewers;

/// Whoever waits longer than this waits for ever.
pub const HANGS_AFTER: std::time::Duration = std::time::Duration::from_secs(60);
