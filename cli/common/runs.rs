//! Which graphs run on this machine, and which one a command means.

use std::path::Path;

use anyhow::{Result, bail};
use carril_runtime::control_plane::{RUN_FILE, RunFile, runs_dir};
use nix::errno::Errno;
use nix::sys::signal::kill;
use nix::unistd::{Pid, getuid};

use super::suggest;

/// The run that `--robot` means; without it, the only one.
pub fn choose(robot: Option<&str>) -> Result<RunFile> {
    let dir = runs_dir(getuid().as_raw());
    choose_from(running(&dir), robot, &dir)
}

/// The runs below `dir` whose supervisor is alive, by name. What is no run file is passed over.
fn running(dir: &Path) -> Vec<RunFile> {
    let Ok(entries) = std::fs::read_dir(dir) else { return Vec::new() };
    let read = |path: &Path| -> Option<RunFile> { serde_json::from_slice(&std::fs::read(path).ok()?).ok() };
    let files = entries.filter_map(|entry| read(&entry.ok()?.path().join(RUN_FILE)));
    let mut runs: Vec<RunFile> = files.filter(|run| is_alive(run.pid)).collect();
    runs.sort_by(|left, right| left.robot.cmp(&right.robot));
    runs
}

/// Whether the process exists; one of another user's does, too.
pub fn is_alive(pid: u32) -> bool {
    i32::try_from(pid).is_ok_and(|pid| pid > 0 && matches!(kill(Pid::from_raw(pid), None), Ok(()) | Err(Errno::EPERM)))
}

fn choose_from(mut runs: Vec<RunFile>, robot: Option<&str>, dir: &Path) -> Result<RunFile> {
    let names: Vec<String> = runs.iter().map(|run| run.robot.clone()).collect();
    let list = names.join(", ");
    match (robot, runs.len()) {
        (_, 0) => bail!(
            "no graph is running (looked in `{}`)\nhint: start one in another terminal: carril run dataflow.yaml",
            dir.display()
        ),
        (None, 1) => Ok(runs.remove(0)),
        (None, _) => bail!("several graphs are running: {list}\nhint: choose one with --robot {}", names[0]),
        (Some(robot), _) => match runs.into_iter().find(|run| run.robot == robot) {
            Some(run) => Ok(run),
            None => {
                let hint = suggest::hint(robot, names.iter().map(String::as_str), "");
                bail!("no graph is running for robot `{robot}`; running are {list}{hint}");
            }
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::common::ports::example_run;

    fn run(robot: &str, pid: u32) -> RunFile {
        RunFile { robot: robot.into(), pid, ..example_run() }
    }

    fn chosen(robots: &[&str], robot: Option<&str>) -> Result<String> {
        let runs = robots.iter().map(|name| run(name, 1)).collect();
        choose_from(runs, robot, Path::new("/run/carril")).map(|run| run.robot)
    }

    #[test]
    fn the_only_run_needs_no_name() {
        assert_eq!(chosen(&["car1"], None).expect("there is one"), "car1", "the only one");
        assert_eq!(chosen(&["car1", "car2"], Some("car2")).expect("it runs"), "car2", "by name");
    }

    #[test]
    fn says_what_to_do_when_there_is_none_or_many() {
        let none = chosen(&[], Some("car1")).expect_err("none").to_string();
        assert!(none.contains("no graph is running") && none.contains("carril run dataflow.yaml"), "{none}");
        let many = chosen(&["car1", "car2"], None).expect_err("two").to_string();
        assert_eq!(many, "several graphs are running: car1, car2\nhint: choose one with --robot car1", "two");
        let wrong = chosen(&["car1"], Some("cra1")).expect_err("another").to_string();
        assert!(wrong.ends_with("did you mean `car1`?"), "{wrong}");
    }

    #[test]
    fn passes_over_runs_that_died_and_files_that_are_none() {
        let dir = tempfile::tempdir().expect("a folder for the test");
        for (name, content) in [
            ("here", serde_json::to_string(&run("here", std::process::id())).expect("it is JSON")),
            ("gone", serde_json::to_string(&run("gone", i32::MAX as u32)).expect("it is JSON")),
            ("junk", "{".to_owned()),
        ] {
            std::fs::create_dir(dir.path().join(name)).expect("the folder is writable");
            std::fs::write(dir.path().join(name).join(RUN_FILE), content).expect("the folder is writable");
        }
        let robots: Vec<String> = running(dir.path()).into_iter().map(|run| run.robot).collect();
        assert_eq!(robots, ["here"], "only the one whose process is alive");
        assert!(running(&dir.path().join("nowhere")).is_empty(), "no folder, no run");
    }
}
