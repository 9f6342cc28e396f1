//! The processes of a benchmark: this program again, in another role. A role says `ready` when it can be measured and prints
//! its result as one line of JSON.

use std::io::{BufRead, BufReader};
use std::process::{Child, ChildStdout, Command, Stdio};

use carril_runtime::transport::zenoh::THREADS;

/// A process in a role. It is ended when this is dropped.
pub struct Role {
    child: Child,
    output: BufReader<ChildStdout>,
}

impl Role {
    /// Starts this program in a role. One that runs nodes gets the environment that the supervisor gives to processes of nodes.
    pub fn start(arguments: &[String]) -> Self {
        Self::start_by(Command::new(std::env::current_exe().expect("this program has a path")), arguments)
    }

    /// By a command that starts this program somewhere else: on another host.
    pub fn start_by(mut command: Command, arguments: &[String]) -> Self {
        if arguments.first().is_some_and(|role| role == "nodes") {
            command.env(THREADS.0, THREADS.1);
        }
        let mut child =
            command.arg("role").args(arguments).stdout(Stdio::piped()).spawn().expect("this program starts again");
        let output = BufReader::new(child.stdout.take().expect("its output is piped"));
        Self { child, output }
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// The next line that it prints.
    pub fn line(&mut self) -> String {
        let mut line = String::new();
        self.output.read_line(&mut line).expect("its output can be read");
        assert!(!line.is_empty(), "the process in role {:?} ended early", self.child.id());
        line.trim().to_owned()
    }

    /// Waits until it can be measured.
    pub fn wait_ready(&mut self) {
        assert_eq!(self.line(), "ready", "a role says first that it is ready");
    }

    /// Its result.
    pub fn result<T: serde::de::DeserializeOwned>(&mut self) -> T {
        serde_json::from_str(&self.line()).expect("a role prints its result as JSON")
    }
}

impl Drop for Role {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
