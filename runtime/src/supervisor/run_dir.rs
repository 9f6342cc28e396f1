//! The folder of a run: made when it starts, gone when it has ended. One run per robot.

use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::sys::signal::kill;
use nix::unistd::Pid;

use super::RunError;
use super::plan::{PLAN_FILE, Plan};
use crate::control_plane::{RUN_FILE, RunFile};

/// A copy of the graph file, for people.
pub const GRAPH_FILE: &str = "graph.yaml";
/// Where the process listens that stands in for the nodes elsewhere: the gateway of a car, the link of another machine.
pub const STAND_IN_SOCKET: &str = "stand-in.sock";
/// Paths of sockets have at most so many bytes (`sun_path` in unix(7), without the final zero).
const MAX_SOCKET_PATH_BYTES: usize = 107;

/// The folder of a run.
#[derive(Debug)]
pub struct RunDir(PathBuf);

/// Whether a process exists; one of another user's does, too.
pub fn is_alive(pid: u32) -> bool {
    i32::try_from(pid).is_ok_and(|pid| pid > 0 && matches!(kill(Pid::from_raw(pid), None), Ok(()) | Err(Errno::EPERM)))
}

/// The run file in a folder. `None`: there is none that can be read.
pub fn read_run_file(dir: &Path) -> Option<RunFile> {
    serde_json::from_slice(&fs::read(dir.join(RUN_FILE)).ok()?).ok()
}

impl RunDir {
    /// Makes `<runs_dir>/<robot>`. Refuses while another run of the same robot is alive; what a dead one left goes.
    pub fn make(runs_dir: &Path, robot: &str) -> Result<Self, RunError> {
        let path = runs_dir.join(robot);
        let failed = |reason: io::Error| RunError::Folder { path: path.clone(), reason };
        let mut builder = fs::DirBuilder::new();
        builder.mode(0o700);
        fs::DirBuilder::new().recursive(true).mode(0o700).create(runs_dir).map_err(failed)?;
        loop {
            match builder.create(&path) {
                Ok(()) => {
                    // At once, so that a second supervisor finds us before there is a run file.
                    write(&path.join("pid"), std::process::id().to_string().as_bytes()).map_err(failed)?;
                    return Ok(Self(path));
                }
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                    if let Some(pid) = owner(&path).filter(|pid| is_alive(*pid)) {
                        return Err(RunError::AlreadyRunning { robot: robot.to_owned(), pid });
                    }
                    tracing::info!("`{}` is left of a run that died; it is removed", path.display());
                    fs::remove_dir_all(&path).map_err(failed)?;
                }
                Err(error) => return Err(failed(error)),
            }
        }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The socket of a process: its name where that fits, else its number.
    pub fn socket(&self, name: &str, number: usize) -> Result<PathBuf, RunError> {
        let fits = |path: &Path| path.as_os_str().len() <= MAX_SOCKET_PATH_BYTES;
        let by_name = self.0.join(format!("{name}.sock"));
        let by_number = self.0.join(format!("{number}.sock"));
        [by_name, by_number]
            .into_iter()
            .find(|path| fits(path))
            .ok_or_else(|| RunError::PathTooLong { path: self.0.clone(), limit: MAX_SOCKET_PATH_BYTES })
    }

    /// Writes what the processes need.
    pub fn write_plan(&self, plan: &Plan) -> Result<(), RunError> {
        let failed = |reason: io::Error| RunError::Folder { path: self.0.clone(), reason };
        let plan = serde_json::to_vec_pretty(plan).map_err(|e| failed(e.into()))?;
        self.replace_file(PLAN_FILE, &plan).map_err(failed)
    }

    /// Keeps a copy of the graph file, for people.
    pub fn write_graph(&self, text: &str) -> Result<(), RunError> {
        let written = self.replace_file(GRAPH_FILE, text.as_bytes());
        written.map_err(|reason| RunError::Folder { path: self.0.clone(), reason })
    }

    /// In one go: whoever reads it sees the old or the new one.
    fn replace_file(&self, name: &str, bytes: &[u8]) -> io::Result<()> {
        let new = self.0.join(format!("{name}.new"));
        write(&new, bytes)?;
        fs::rename(&new, self.0.join(name))
    }

    /// Writes the run file.
    pub fn write_run_file(&self, run: &RunFile) -> Result<(), RunError> {
        let failed = |reason: io::Error| RunError::Folder { path: self.0.clone(), reason };
        let text = serde_json::to_vec_pretty(run).map_err(|e| failed(e.into()))?;
        self.replace_file(RUN_FILE, &text).map_err(failed)
    }

    /// Sockets of the tools that are connected now: a process that starts later connects to them.
    pub fn tool_sockets(&self) -> Vec<PathBuf> {
        let entries = fs::read_dir(&self.0).into_iter().flatten().flatten();
        let stand_in = self.0.join(STAND_IN_SOCKET);
        let is_tool = |path: &PathBuf| *path == stand_in || tool_pid(path).is_some_and(is_alive);
        entries.map(|entry| entry.path()).filter(is_tool).collect()
    }

    /// What a process that could not start left for us.
    pub fn take_error(&self, process: &str) -> Option<String> {
        let path = self.0.join(format!("{process}.error"));
        let text = fs::read_to_string(&path).ok()?;
        // It is gone with the folder at the latest.
        let _ = fs::remove_file(path);
        Some(text)
    }
}

impl Drop for RunDir {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.0) {
            tracing::warn!("`{}` cannot be removed: {error}", self.0.display());
        }
    }
}

/// The socket of a tool: a process that looks on.
pub fn tool_socket(dir: &Path, pid: u32) -> PathBuf {
    dir.join(format!("tool-{pid}.sock"))
}

fn tool_pid(path: &Path) -> Option<u32> {
    path.file_name()?.to_str()?.strip_prefix("tool-")?.strip_suffix(".sock")?.parse().ok()
}

fn owner(path: &Path) -> Option<u32> {
    fs::read_to_string(path.join("pid")).ok()?.trim().parse().ok()
}

fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = fs::OpenOptions::new().write(true).create(true).truncate(true).mode(0o600).open(path)?;
    file.write_all(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refuses_a_second_run_of_the_same_robot() {
        let runs = tempfile::tempdir().expect("a temporary folder");
        let first = RunDir::make(runs.path(), "car1").expect("the first run");
        let second = RunDir::make(runs.path(), "car1").expect_err("the second run").to_string();
        let pid = std::process::id().to_string();
        assert!(second.contains("`car1`") && second.contains(&pid), "it says who runs: {second}");
        drop(first);
        assert!(!runs.path().join("car1").exists(), "the folder goes with the run");
        RunDir::make(runs.path(), "car1").expect("and the robot is free again");
    }

    #[test]
    fn takes_over_from_a_dead_run() {
        let runs = tempfile::tempdir().expect("a temporary folder");
        let dir = runs.path().join("car1");
        fs::create_dir(&dir).expect("the folder is writable");
        fs::write(dir.join("pid"), i32::MAX.to_string()).expect("the folder is writable");
        fs::write(dir.join("old.sock"), "").expect("the folder is writable");
        let run = RunDir::make(runs.path(), "car1").expect("nobody with that id is alive");
        assert!(!run.path().join("old.sock").exists(), "what it left is gone");
    }

    #[test]
    fn long_names_get_short_sockets() {
        let runs = tempfile::tempdir().expect("a temporary folder");
        let run = RunDir::make(runs.path(), "car1").expect("a run");
        let socket = run.socket(&"x".repeat(100), 3).expect("the number fits");
        assert_eq!(socket.file_name().and_then(|name| name.to_str()), Some("3.sock"), "its number");
        let deep = RunDir(PathBuf::from(format!("/{}", "y".repeat(120))));
        let error = deep.socket("a", 0).expect_err("nothing fits").to_string();
        assert!(error.contains("CARRIL_RUN_DIR"), "it says what to do: {error}");
        std::mem::forget(deep);
    }
}
