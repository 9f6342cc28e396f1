//! What several commands share.

pub mod applied;
pub mod assignments;
pub mod companion;
pub mod drive;
pub mod flow;
pub mod graph_edit;
pub mod graph_file;
pub mod interrupt;
pub mod live;
pub mod nodes;
pub mod output;
pub mod outside;
pub mod ports;
pub mod profiles;
pub mod receipt;
pub mod registry;
pub mod report;
pub mod save;
pub mod statistics;
pub mod suggest;
pub mod text;
pub mod time;
pub mod usage;
pub mod watch;
pub mod way;
pub mod wheel;
