//! What goes wrong while `lane` of the default graph is replaced: candidates that fail in every way, candidates and supervisors that are
//! killed in every phase. The car stays in its lane, or, without a supervisor, stops by itself.

mod support;

use carril_messages::Fault;
use serde_json::Value;
use support::car::{
    Car, EVERY_FRAME, Phase, assert_one_estimate_per_frame, bad_program, kill_at_once, patient_graph, processes,
    receipt, until,
};
use support::chip::{Chip, on_the_line};
use support::thorough::{count, is_thorough};
use support::{Sandbox, program};

/// `lane` is a `bad-lane` that behaves: it has a state, and the candidates are other binaries.
fn graph_with_bad_lane(sandbox: &Sandbox, more: &[(&str, &str)]) -> String {
    let exec = format!("exec: {}", bad_program(sandbox, "first-lane").display());
    let own = [
        ("operator: lane-detector", exec.as_str()),
        ("    config: { threshold: 190, row_far: 0.75, row_near: 0.85 }\n", ""),
    ];
    patient_graph(&[&own, &EVERY_FRAME, more].concat())
}

fn drive() -> Car {
    let sandbox = Sandbox::new();
    let graph = graph_with_bad_lane(&sandbox, &[]);
    let car = Car::launch_standing(sandbox, &graph);
    car.until_it("drives", "lane-follow");
    car
}

#[track_caller]
fn assert_failed(what: &str, receipt: &Value, phase: &str, reason: &str) {
    let outcome = if ["hand-over", "probation"].contains(&phase) { "rolled_back" } else { "refused" };
    assert_eq!((&receipt["outcome"], &receipt["phase"]), (&outcome.into(), &phase.into()), "{what}: {receipt}");
    let given = receipt["reason"].as_str().unwrap_or_default();
    assert!(given.contains(reason), "{what}: `{reason}` in the reason: {receipt}");
    assert_eq!(receipt["lost"], 0, "{what}: nothing is lost: {receipt}");
}

/// The one that ran goes on, in the same process, and nothing of the candidate is left.
#[track_caller]
fn assert_goes_on(what: &str, car: &Car, lane: i32) {
    until(&format!("{what}: the candidate is gone"), || car.candidate().is_none());
    let still = processes(&car.sandbox).into_iter().find(|(_, name)| name == "lane");
    assert_eq!(still.map(|(pid, _)| pid), Some(lane), "{what}: the process that ran goes on");
}

fn lane_process(car: &Car) -> i32 {
    processes(&car.sandbox).into_iter().find(|(_, name)| name == "lane").expect("it runs").0
}

/// Faults in shadow have long to show, and those on probation show only there.
const IN_SHADOW: &[&str] = &["--shadow", "20s"];
const ON_PROBATION: &[&str] = &["--shadow", "100ms", "--probation", "100000"];

#[test]
fn a_bad_candidate_changes_nothing_for_the_car() {
    let car = drive();
    let lane = lane_process(&car);
    let (frames, estimates) = (car.hear_headers("world/camera"), car.hear_headers("lane/lane"));
    estimates.wait_for(5);
    let cases: &[(&str, &str, &[&str], &str, &str)] = &[
        ("other-ports", "", &[], "request", "does not fit as node `lane`"),
        ("bad-lane", "refuse_config=true", &[], "request", "got true, allowed is false"),
        ("bad-lane", "die_at_check=true", &[], "request", "--check-config` failed"),
        ("bad-lane", "panick_at=3", &[], "request", "panic_at"),
        ("dies-at-start", "", &[], "start", "exit code 9"),
        ("bad-lane", "crash_at_start=true", &[], "prepare", "its process died"),
        ("bad-lane", "refuse_setup=true", &[], "prepare", "told to refuse"),
        ("bad-lane", "refuse_state=true", &[], "prepare", "told to refuse the state"),
        ("bad-lane", "panic_at=3", IN_SHADOW, "shadow", "told to panic"),
        ("bad-lane", "fail_from=3", IN_SHADOW, "shadow", "told to fail"),
        ("bad-lane", "stall_at=3", IN_SHADOW, "shadow", "it stalls"),
        ("bad-lane", "garbage_from=3", IN_SHADOW, "shadow", "it publishes garbage"),
        ("bad-lane", "grow_mb=40", IN_SHADOW, "shadow", "of memory, allowed are 400 MB"),
        ("bad-lane", "after_states=2,panic_at=5", ON_PROBATION, "probation", "told to panic"),
        ("bad-lane", "after_states=2,fail_from=5", ON_PROBATION, "probation", "told to fail"),
        ("bad-lane", "after_states=2,stall_at=5", ON_PROBATION, "probation", "it stalls"),
        ("bad-lane", "after_states=2,garbage_from=5", ON_PROBATION, "probation", "it publishes garbage"),
        ("bad-lane", "after_states=2,grow_mb=40", ON_PROBATION, "probation", "of memory, allowed are 400 MB"),
    ];
    for (program, values, terms, phase, reason) in cases {
        let what = format!("{program} {values} {phase}");
        let exec = car.bad(program);
        let set: &[&str] = if values.is_empty() { &[] } else { &["--set", values] };
        let args = [&["lane", "--exec", &exec, "--memory-limit-mb", "400"], set, terms].concat();
        // A busy machine is no stall; a true one shall be found before the car has gone far without an estimate.
        let stall_ms = if *reason == "it stalls" { "300" } else { "1000" };
        let receipt = car.change(&[&["swap"], &args[..], &["--stall-ms", stall_ms]].concat());
        assert_failed(&what, &receipt, phase, reason);
        assert_goes_on(&what, &car, lane);
        assert_one_estimate_per_frame(&frames.headers(), &estimates.headers());
    }
    if is_thorough() {
        let exec = car.bad("slow-to-start");
        let receipt = car.try_swap(&["lane", "--exec", &exec]);
        assert_failed("slow-to-start", &receipt, "start", "was not ready within");
        assert_goes_on("slow-to-start", &car, lane);
    }
    estimates.wait_for(5);
    assert_one_estimate_per_frame(&frames.headers(), &estimates.headers());
    car.assert_in_the_lane();
    car.end();
}

#[test]
fn a_candidate_that_is_killed_changes_nothing_for_the_car() {
    let car = drive();
    let lane = lane_process(&car);
    let (frames, estimates) = (car.hear_headers("world/camera"), car.hear_headers("lane/lane"));
    estimates.wait_for(5);
    for phase in Phase::ALL {
        let what = format!("killed in phase {}", phase.name());
        let (command, candidate) = car.swap_as_far_as(phase);
        kill_at_once(candidate);
        assert_failed(&what, &receipt(&command.wait()), phase.name(), "killed by SIGKILL");
        assert_goes_on(&what, &car, lane);
    }
    estimates.wait_for(5);
    assert_one_estimate_per_frame(&frames.headers(), &estimates.headers());
    car.assert_in_the_lane();
    car.end();
}

#[test]
fn what_is_no_successor_is_refused_at_once() {
    let car = Car::launch(&patient_graph(&[]));
    let binary = program("my-lane").display().to_string();
    let cases: [&[&str]; 4] = [
        &["swap", "lane", "--set", "threshold=300"],
        &["swap", "lane", "--operator", "lidar-sectors"],
        &["swap", "sectors", "--exec", &binary],
        &["swap", "lane", "--exec", "/bin/true"],
    ];
    for case in cases {
        let receipt = car.change(case);
        assert_failed(&format!("{case:?}"), &receipt, "request", "");
        assert!(receipt["reason"].as_str().is_some_and(|reason| !reason.is_empty()), "{case:?}: {receipt}");
    }
    let compared = car.change(&["shadow", "lane", "--set", "threshold=170", "--seconds", "1"]);
    assert_eq!(compared["outcome"], "compared", "{compared}");
    assert!(compared["compared"].as_u64() > Some(0), "{compared}");
    car.assert_in_the_lane();
    car.end();
}

/// The test itself is the microcontroller: it outlives the run.
fn graph_on_the_line(sandbox: &Sandbox, chip: &Chip) -> String {
    on_the_line(&graph_with_bad_lane(sandbox, &[("lease_ms: 1500", "lease_ms: 1000")]), chip)
}

#[test]
fn without_its_supervisor_the_car_stops_by_itself_in_every_phase_of_a_swap() {
    let chip = Chip::new();
    let mut sandbox = Sandbox::new();
    let graph = graph_on_the_line(&sandbox, &chip);
    for phase in count(&Phase::ALL[3..4], &Phase::ALL) {
        let car = Car::launch_standing(sandbox, &graph);
        // From the second round on the chip still holds the fault of the round before.
        until("the car drives", || {
            let word = |word: &str| car.sandbox.carril(&[word]).code == Some(0);
            chip.drives() || (word("reset") && word("start") && chip.drives())
        });
        assert!(chip.now().faults.is_empty(), "nothing is wrong: {:?}", chip.now());
        let (command, candidate) = car.swap_as_far_as(*phase);
        let running = processes(&car.sandbox);
        assert!(running.iter().any(|(pid, _)| *pid == candidate) && running.len() == 7, "six and one: {running:?}");
        sandbox = car.kill_supervisor();
        until(&format!("{}: the car stands", phase.name()), || chip.brakes());
        assert!(chip.now().faults.contains(Fault::LeaseExpired), "the lease ran out: {:?}", chip.now());
        until(&format!("{}: every process has ended", phase.name()), || processes(&sandbox).is_empty());
        let told = command.wait();
        assert_ne!(told.code, Some(0), "{}: nobody says that it went through: {}", phase.name(), told.report());
    }
    // The last one leaves a folder behind, too; the next run finds no trace of it.
    let car = Car::launch_standing(sandbox, &graph);
    let left = std::fs::read_dir(car.sandbox.path().join("runs/car1/bin")).map_or(0, Iterator::count);
    assert_eq!(left, 0, "no binary of a candidate is left");
    car.sandbox.carril(&["reset"]).expect(0);
    car.sandbox.carril(&["start"]).expect(0);
    until("the car drives", || chip.drives());
    let exec = car.bad("bad-lane");
    car.swap(&["lane", "--exec", &exec, "--shadow", "100ms"]);
    car.end();
}

#[test]
fn a_candidate_that_says_nothing_does_not_take_over() {
    let car = drive();
    let exec = car.bad("bad-lane");
    let receipt = car.try_swap(&["lane", "--exec", &exec, "--set", "silent_from=1", "--shadow", "1s"]);
    assert_failed("silent", &receipt, "shadow", "");
    car.end();
}

#[test]
fn a_binary_that_was_built_anew_over_the_one_that_runs_is_the_one_that_comes() {
    let car = drive();
    let (path, fresh) = (car.sandbox.path().join("first-lane"), car.bad("bad-lane"));
    std::fs::rename(fresh, &path).expect("the sandbox is writable");
    let lane = lane_process(&car);
    car.swap(&["lane", "--exec", &path.display().to_string(), "--shadow", "100ms"]);
    let now = processes(&car.sandbox).into_iter().find(|(_, name)| name.starts_with("lane.")).map(|(pid, _)| pid);
    assert!(now.is_some_and(|pid| pid != lane), "the new build runs, in a process of its own: {now:?}");
    car.end();
}
