//! `carril service`: the unit that it writes, and what it says where there is no systemd.

mod support;

use std::path::Path;
use std::process::Command;

use support::{Outcome, Sandbox, neutral};

fn print(sandbox: &Sandbox, more: &[&str]) -> Outcome {
    let args = ["service", "install", "dataflows/two-machines.yaml", "--print", "--user", "root"];
    let mut command = sandbox.command(&[&args, more].concat());
    command.env_remove("CARRIL_CONFIG_DIR");
    support::Running::start(command).wait()
}

#[test]
fn the_unit_runs_the_graph_as_people_do() {
    let sandbox = Sandbox::new();
    let unit = print(&sandbox, &[]).expect(0);
    let shown = neutral(&unit.replace(Sandbox::PROGRAM, "CARRIL"));
    insta::assert_snapshot!("service_car", shown);
    let laptop = print(&sandbox, &["--machine", "laptop", "--connect", "car.local"]).expect(0);
    assert!(laptop.contains("--machine laptop --connect car.local"), "{laptop}");
    assert!(laptop.contains("RuntimeDirectory=carril/car1-laptop"), "beside that of the car: {laptop}");

    let file = sandbox.write("carril-test.service", unit);
    match Command::new("systemd-analyze").arg("verify").arg(&file).output() {
        Ok(verified) => {
            let said = String::from_utf8_lossy(&verified.stderr).into_owned();
            assert!(!said.contains("carril-test.service"), "systemd finds fault with it: {said}");
        }
        Err(error) => eprintln!("not checked by systemd-analyze: {error}"),
    }
}

#[test]
fn what_cannot_be_a_service_is_refused() {
    let sandbox = Sandbox::new();
    let install = |args: &[&str]| sandbox.carril(&[&["service", "install"], args].concat());
    let nobody = install(&["dataflow.yaml", "--print", "--user", "nobody-of-that-name"]).expect_error(1);
    assert!(nobody.contains("there is no user"), "{nobody}");
    let bad = sandbox.write("bad.yaml", "robot: car1\nnodes: {}\n").display().to_string();
    assert!(install(&[&bad, "--print", "--user", "root"]).expect_error(1).contains("no-nodes"), "a wrong graph");
    let machine = install(&["dataflow.yaml", "--machine", "laptop", "--print", "--user", "root"]).expect_error(1);
    assert!(machine.contains("no node of the graph is placed on machine `laptop`"), "{machine}");
    if Path::new("/run/systemd/system").is_dir() {
        eprintln!("not tried: this machine runs systemd, and nothing may be installed on it");
        return;
    }
    for args in [
        &["service", "install", "dataflow.yaml", "--user", "root"][..],
        &["service", "uninstall"],
        &["service", "status"],
    ] {
        let none = sandbox.carril(args).expect_error(1);
        assert!(none.contains("was not started by systemd"), "{args:?}: {none}");
    }
}
