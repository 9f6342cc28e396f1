//! The commands, one file each.

pub mod check;
pub mod control;
pub mod echo;
pub mod graph;
pub mod list;
pub mod operators;
pub mod publish;
pub mod rates;
pub mod sim;
pub mod top;
