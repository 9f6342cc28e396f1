//! The far end of a `sim:` line, for whatever plays the microcontroller: memory in lockstep, a pseudo-terminal live.

use carril_messages::Stamp;
use carril_runtime::lines::{End, MemoryLine};
use carril_runtime::{Setup, SetupError};

use crate::pty::Pty;

/// The device's end of a line.
pub enum DeviceLine {
    /// In virtual time.
    Memory(MemoryLine),
    /// In real time.
    Terminal(Pty),
}

impl DeviceLine {
    /// Opens the line of that name.
    pub fn open(name: &str, setup: &Setup) -> Result<Self, SetupError> {
        match (&setup.memory_lines, &setup.run_dir) {
            (Some(lines), _) => Ok(Self::Memory(lines.open(name, End::Device, setup.waker.clone()))),
            (None, Some(run_dir)) => {
                let link = run_dir.join(name);
                let pty = Pty::create(link.clone(), setup.clock.clone(), setup.waker.clone()).map_err(|error| {
                    SetupError::new(format!("cannot make a pseudo-terminal at `{}`: {error}", link.display()))
                })?;
                Ok(Self::Terminal(pty))
            }
            (None, None) => Err(SetupError::new(format!(
                "line `{name}` needs the folder of a run to put its terminal in; use `carril run`"
            ))),
        }
    }

    /// What has come, with the times at which it did.
    pub fn take(&self, now: Stamp) -> Vec<(Stamp, Vec<u8>)> {
        match self {
            Self::Memory(line) => {
                let mut bytes = Vec::new();
                line.read_into(&mut bytes);
                vec![(now, bytes)]
            }
            Self::Terminal(pty) => pty.take(),
        }
    }

    /// Sends bytes.
    pub fn write(&self, bytes: &[u8]) {
        match self {
            Self::Memory(line) => line.write(bytes),
            Self::Terminal(pty) => pty.write(bytes),
        }
    }
}
