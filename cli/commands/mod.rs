//! The commands, one file each.

pub mod operators;
pub mod publish;
