//! The commands, one file each.

pub mod check;
pub mod control;
pub mod echo;
pub mod graph;
pub mod list;
pub mod operators;
pub mod process;
pub mod publish;
pub mod rates;
pub mod run;
pub mod sim;
pub mod swap;
pub mod top;
