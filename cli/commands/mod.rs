//! The commands, one file each.

pub mod access;
pub mod apply;
pub mod calibrate;
pub mod check;
pub mod control;
pub mod dashboard;
pub mod doctor;
pub mod echo;
pub mod gateway;
pub mod graph;
pub mod list;
pub mod machine;
pub mod new;
pub mod operators;
pub mod params;
pub mod process;
pub mod publish;
pub mod rates;
pub mod run;
pub mod scenarios;
pub mod service;
pub mod set;
pub mod sim;
pub mod swap;
pub mod top;
pub mod watch;
