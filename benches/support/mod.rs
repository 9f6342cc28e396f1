//! What the benchmarks share.

pub mod car;
pub mod children;
pub mod measure;
pub mod nodes;
pub mod plain;
pub mod report;
