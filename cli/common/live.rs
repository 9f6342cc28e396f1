//! TEMP
use std::sync::Arc;
use std::time::Duration;

use anyhow::Result;
use carril_messages::Control;
use carril_runtime::control_plane::{ControlReply, RunFile, Status};

use super::ports::Port;
use super::watch::Recorder;

pub struct Run {
    file: RunFile,
}
impl Run {
    pub fn connect(_robot: Option<&str>) -> Result<Self> {
        todo!()
    }
    pub fn file(&self) -> &RunFile {
        &self.file
    }
    pub fn subscribe(&self, _port: &Port, _recorder: Arc<Recorder>) -> Result<()> {
        todo!()
    }
    pub fn check_alive(&self) -> Result<()> {
        todo!()
    }
    pub fn explain_silence(&self, _port: &Port) -> String {
        todo!()
    }
    pub fn next_status(&self, _timeout: Duration) -> Result<Option<Status>> {
        todo!()
    }
    pub fn publish_on(&self, _node: &str, _port: &str, _t: carril_messages::MessageType) -> Result<Publisher> {
        todo!()
    }
    pub fn control(&self, _word: Control) -> Result<Vec<ControlReply>> {
        todo!()
    }
}
pub struct Publisher;
impl Publisher {
    pub fn put(&self, _: &carril_messages::Encoded) -> Result<()> {
        todo!()
    }
}
