//! The lockstep executor: virtual time, order, busy nodes, wakes, control words, budgets, faults, and the same bytes twice.

mod support;

use std::cell::RefCell;
use std::path::Path;
use std::rc::Rc;
use std::time::Duration;

use carril_runtime::executor::lockstep::{Lockstep, LockstepError, LockstepOptions, LockstepSummary};
use carril_runtime::graph::{Graph, ReadOptions};
use carril_runtime::messages::{Command, Control, DecisionState, DriveState, Goal, NodeState, Stamp};
use support::probes;

fn parse(text: &str) -> Graph {
    let registry = support::registry().and(probes::registry());
    match Graph::parse(text.to_owned(), Path::new("test.yaml"), &registry, &ReadOptions::default()) {
        Ok(graph) => graph,
        Err(problems) => panic!("the test's graph must be clean:\n{problems}"),
    }
}

fn lockstep(text: &str) -> Lockstep {
    Lockstep::new(&parse(text), LockstepOptions::default()).expect("every operator of the test can be built")
}

fn ms(ms: i64) -> Stamp {
    Stamp::from_nanos(ms * 1_000_000)
}

/// What the probes of a graph did: virtual ms, node, trigger, number read.
fn trace(lockstep: &mut Lockstep, node: &str) -> Rc<RefCell<Vec<(i64, u64)>>> {
    let trace = Rc::new(RefCell::new(Vec::new()));
    let into = Rc::clone(&trace);
    let hear = move |published: &carril_runtime::node::Published| {
        let at = published.header.stamp.as_nanos() / 1_000_000;
        into.borrow_mut().push((at, published.header.seq));
    };
    lockstep.subscribe(node, "ticks", hear).expect("the port is there");
    trace
}

const OVAL: &str = include_str!("../../tests/dataflows/good/oval.yaml");

fn run_oval(seed: u64) -> LockstepSummary {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/dataflows/good/oval.yaml");
    let graph = Graph::parse(OVAL.to_owned(), &path, &support::registry(), &ReadOptions::default());
    let options = LockstepOptions { seed, ..LockstepOptions::default() };
    let mut lockstep = Lockstep::new(&graph.expect("a good file"), options).expect("it can be built");
    lockstep.run_until(Stamp::from_nanos(10_000_000_000)).expect("nothing panics");
    lockstep.finish()
}

#[test]
fn one_seed_gives_one_hash_and_another_seed_another() {
    let (first, second, other) = (run_oval(7), run_oval(7), run_oval(8));
    assert_eq!(first.hash, second.hash, "the same seed, the same bytes");
    assert_ne!(first.hash, other.hash, "the seed reaches the operators");
    let steps = |summary: &LockstepSummary| summary.nodes.iter().map(|node| node.steps).collect::<Vec<_>>();
    assert_eq!(steps(&first), steps(&second), "the same steps");
    assert!(
        first.node("mcu").is_some_and(|mcu| mcu.steps > 5000),
        "500 per second and one per byte string from the host"
    );
    for node in &first.nodes {
        let ports: u64 = node.health.outputs.iter().map(|output| output.sent).sum();
        assert_eq!(ports, node.sent, "{}: port by port as in all", node.node);
    }
    let camera = first.nodes.iter().flat_map(|node| &node.health.outputs).find(|output| output.port == "camera");
    let camera = camera.expect("the world has one");
    assert!(camera.sent > 0 && camera.bytes == camera.sent * 16 * 8, "whole images: {camera:?}");
    let age = first.node("lane").and_then(|lane| lane.age_ms).expect("it derives from the camera");
    assert!(age.p99 < 1e-3, "computing takes no virtual time: {age:?}");
    assert!((first.virtual_s - 10.0).abs() < 1e-9, "10 s, got {}", first.virtual_s);
}

#[test]
fn periods_fall_on_their_multiples() {
    let mut lockstep = lockstep("robot: r\nnodes: {a: {operator: ticker, period_ms: 10}}");
    let trace = trace(&mut lockstep, "a");
    lockstep.run_until(ms(30)).expect("nothing panics");
    assert_eq!(*trace.borrow(), [(0, 0), (10, 1), (20, 2), (30, 3)], "0 and the end included");
}

#[test]
fn latency_and_delay_add_up_and_a_busy_node_waits() {
    let mut lockstep = lockstep(
        "robot: r\nnodes:\n  a: {operator: ticker, period_ms: 10}\n  \
         b: {operator: relay, inputs: {given: {from: a/ticks, delay_ms: 2, queue: 8}}, latency_ms: 15}",
    );
    let trace = trace(&mut lockstep, "b");
    lockstep.run_until(ms(60)).expect("nothing panics");
    // Arrivals at 2, 12, 22, ...; steps at 2 (until 17), 17 (takes 12; until 32), 32 (takes 22 and 32; until 47), 47 (takes 42).
    assert_eq!(*trace.borrow(), [(17, 0), (32, 1), (47, 2), (47, 3)], "the ends of the steps");
}

#[test]
fn a_step_sees_everything_that_arrives_at_its_moment() {
    let mut lockstep = lockstep(
        "robot: r\nnodes:\n  a: {operator: ticker, period_ms: 10}\n  b: {operator: ticker, period_ms: 10}\n  \
         sum: {operator: pair, inputs: {left: {from: a/ticks, delay_ms: 1}, right: {from: b/ticks, delay_ms: 1}}}",
    );
    let trace = trace(&mut lockstep, "sum");
    lockstep.run_until(ms(25)).expect("nothing panics");
    assert_eq!(*trace.borrow(), [(1, 0), (11, 1), (21, 2)], "one step for two samples of one moment");
}

#[test]
fn a_cycle_with_a_delay_goes_round() {
    let mut lockstep = lockstep(
        "robot: r\nnodes:\n  a: {operator: pair, inputs: {left: kick/ticks, right: {from: b/ticks, delay_ms: 4}}}\n  \
         b: {operator: relay, inputs: {given: a/ticks}}\n  kick: {operator: ticker, period_ms: 1000}",
    );
    let trace = trace(&mut lockstep, "b");
    lockstep.run_until(ms(13)).expect("nothing panics");
    assert_eq!(*trace.borrow(), [(0, 0), (4, 1), (8, 2), (12, 3)], "once per delay");
}

#[test]
fn a_waker_makes_the_node_step_at_the_same_virtual_time() {
    let mut lockstep = lockstep(
        "robot: r\nnodes:\n  bridge: {operator: mcu-link, inputs: {command: a/command}}\n  \
         mcu: {operator: sim-mcu, inputs: {sensors: w/sensors}}\n  a: {operator: actuator, inputs: {command: d/command}}\n  \
         d: {operator: decision, inputs: {lane: l/lane}}\n  l: {operator: lane-detector, inputs: {image: w/camera}}\n  \
         w: {operator: sim-world}",
    );
    lockstep.run_until(ms(100)).expect("nothing panics");
    let summary = lockstep.finish();
    let (bridge, mcu) = (summary.node("bridge").expect("there"), summary.node("mcu").expect("there"));
    assert_eq!(mcu.steps, bridge.steps, "a wake for each command on the line; {} and {}", mcu.steps, bridge.steps);
    assert!(mcu.steps >= 11, "every 10 ms and more, got {}", mcu.steps);
}

#[test]
fn a_cut_line_carries_nothing() {
    let text = "robot: r\nnodes:\n  bridge: {operator: mcu-link, inputs: {command: a/command}}\n  \
         mcu: {operator: sim-mcu, inputs: {sensors: w/sensors}}\n  a: {operator: actuator, inputs: {command: d/command}}\n  \
         d: {operator: decision, inputs: {lane: l/lane}}\n  l: {operator: lane-detector, inputs: {image: w/camera}}\n  \
         w: {operator: sim-world}";
    let mut lockstep = lockstep(text);
    lockstep.lines().set_cut("mcu", true);
    lockstep.run_until(ms(100)).expect("nothing panics");
    assert_eq!(lockstep.finish().node("mcu").map(|mcu| mcu.steps), Some(0), "nothing wakes it");
}

#[test]
fn words_reach_every_node_at_their_time() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/dataflows/good/oval.yaml");
    let graph =
        Graph::parse(OVAL.to_owned(), &path, &support::registry(), &ReadOptions::default()).expect("a good file");
    let mut lockstep = Lockstep::new(&graph, LockstepOptions::default()).expect("it can be built");
    lockstep.control_at(ms(500), Control::EStop);
    lockstep.run_until(ms(499)).expect("nothing panics");
    let speed = |lockstep: &Lockstep| lockstep.last::<Command>("decision", "command").map(|command| command.speed_m_s);
    assert_eq!(speed(&lockstep), Some(0.5), "it drives");
    lockstep.run_until(ms(500)).expect("nothing panics");
    let state = lockstep.last::<DecisionState>("decision", "state").expect("it has spoken");
    assert_eq!((state.state, speed(&lockstep)), (DriveState::EStop, Some(0.0)), "at once");
    lockstep.control(Control::Reset);
    lockstep.control(Control::Start);
    lockstep.run_until(ms(501)).expect("nothing panics");
    assert_eq!(speed(&lockstep), Some(0.5), "after reset and start");
    assert!(lockstep.last::<Goal>("decision", "command").is_none(), "another type is not given out");
}

#[test]
fn an_output_is_wanted_when_an_edge_or_a_subscriber_reads_it() {
    let text = "robot: r\nnodes: {w: {operator: sim-world, period_ms: 10}}";
    let count = |subscribe: bool| {
        let mut lockstep = lockstep(text);
        if subscribe {
            lockstep.subscribe("w", "camera", |_| ()).expect("the port is there");
        }
        lockstep.run_until(ms(90)).expect("nothing panics");
        lockstep.finish().nodes[0].sent
    };
    assert_eq!((count(false), count(true)), (20, 30), "scan and sensors; with a reader, frames too");
}

#[test]
fn an_input_takes_samples_from_outside() {
    let mut lockstep = lockstep("robot: r\nnodes: {b: {operator: relay}}");
    let trace = trace(&mut lockstep, "b");
    lockstep.run_until(ms(5)).expect("nothing panics");
    lockstep.put("b", "given", probes::Tick { number: 3 }).expect("the port is there");
    let error = lockstep.put("b", "tocks", probes::Tick { number: 3 }).expect_err("no such port");
    assert_eq!(error.to_string(), "there is no input `b/tocks`", "the message");
    lockstep.run_until(ms(6)).expect("nothing panics");
    assert_eq!(*trace.borrow(), [(5, 0)], "it steps at the moment of the sample");
}

#[test]
fn a_broken_budget_stops_the_car_once_it_persists() {
    let text = "robot: r\nnodes:\n  w: {operator: sim-world, period_ms: 10}\n  \
         l: {operator: lane-detector, inputs: {image: w/camera}, latency_ms: 5}\n  \
         d: {operator: decision, inputs: {lane: l/lane}, config: {auto_start: true}}\n\
         budgets: [{from: w/camera, to: END, max_age_ms: 5, on_violation: stop}]";
    for end in ["d/lane", "d/command"] {
        let mut graph = parse(&text.replace("END", end));
        graph.nodes[1].modelled_latency = Duration::from_millis(7);
        let mut lockstep = Lockstep::new(&graph, LockstepOptions::default()).expect("it can be built");
        lockstep.run_until(ms(200)).expect("nothing panics");
        let faults = lockstep.faults();
        assert_eq!(faults.len(), 1, "to {end}: {faults:?}");
        assert_eq!((faults[0].node.as_str(), faults[0].at), ("d", ms(27)), "to {end}: the third sample in a row");
        let expected = format!("samples at `{end}` are 7.0 ms old, the budget is 5.0 ms");
        assert_eq!(faults[0].reason, expected, "to {end}");
        let command = lockstep.last::<Command>("d", "command").expect("it answers the word");
        assert_eq!(command.speed_m_s, 0.0, "to {end}: every node hears `estop`");
    }
}

/// A node whose every step takes 15 ms, with a deadline of 10 ms and a period of 20 ms, fed every 4 ms.
fn overrunning(on_overrun: &str) -> Lockstep {
    let text = format!(
        "robot: r\nnodes:\n  a: {{operator: ticker, period_ms: 4}}\n  \
         b: {{operator: relay, inputs: {{given: {{from: a/ticks, queue: 8}}}}, deadline_ms: 10, on_overrun: {on_overrun}}}"
    );
    let mut graph = parse(&text);
    graph.nodes[1].modelled_latency = Duration::from_millis(15);
    Lockstep::new(&graph, LockstepOptions::default()).expect("it can be built")
}

#[test]
fn an_overrun_warns_skips_or_stops() {
    let run = |on_overrun: &str| {
        let mut lockstep = overrunning(on_overrun);
        let trace = trace(&mut lockstep, "b");
        lockstep.run_until(ms(40)).expect("nothing panics");
        let trace: Vec<_> = trace.borrow().iter().map(|&(at, _)| at).collect();
        (trace, lockstep.finish())
    };
    let (trace, summary) = run("warn");
    assert_eq!(trace, [15, 30, 30, 30], "what queued up during the first step is done in the second");
    assert_eq!(
        summary.node("b").map(|b| (b.overruns, b.health.inputs[0].dropped)),
        Some((3, 0)),
        "counted, nothing lost"
    );
    let (trace, summary) = run("skip");
    assert_eq!(trace, [15, 31], "what came at 4, 8 and 12 is dropped; the next step begins with 16");
    assert_eq!(summary.node("b").map(|b| b.health.inputs[0].dropped), Some(6), "4, 8, 12 and 20, 24, 28");
    let (_, summary) = run("stop");
    let fault = summary.faults.first().expect("the car stops");
    assert_eq!(fault.reason, "a step took 15.0 ms, longer than the deadline", "why");
    assert_eq!((fault.node.as_str(), fault.at), ("b", Stamp::ZERO), "who and when");
}

/// When the steps of a node with a period of 10 ms and a deadline of 3 ms began.
fn begins_of_steps(latency_ms: u64, on_overrun: &str) -> Vec<i64> {
    let mut graph = parse(&format!(
        "robot: r\nnodes: {{a: {{operator: ticker, period_ms: 10, deadline_ms: 3, on_overrun: {on_overrun}}}}}"
    ));
    graph.nodes[0].modelled_latency = Duration::from_millis(latency_ms);
    let mut lockstep = Lockstep::new(&graph, LockstepOptions::default()).expect("it can be built");
    let trace = trace(&mut lockstep, "a");
    lockstep.run_until(ms(60)).expect("nothing panics");
    let latency_ms = latency_ms as i64;
    trace.borrow().iter().map(|&(end, _)| end - latency_ms).collect()
}

#[test]
fn an_overrun_that_skips_leaves_out_exactly_one_period() {
    assert_eq!(begins_of_steps(2, "skip"), [0, 10, 20, 30, 40, 50], "within the deadline");
    assert_eq!(begins_of_steps(5, "warn"), [0, 10, 20, 30, 40, 50], "only told");
    assert_eq!(begins_of_steps(5, "skip"), [0, 20, 40], "over before the next period comes");
    assert_eq!(begins_of_steps(15, "skip"), [0, 20, 40], "the period that came meanwhile is the one left out");
}

#[test]
fn health_says_since_when_a_node_is_in_its_state() {
    let state_at = |end_ms: i64| {
        let mut lockstep = lockstep(
            "robot: r\nnodes:\n  a: {operator: ticker, period_ms: 10}\n  b: {operator: moody, inputs: {given: a/ticks}}",
        );
        lockstep.run_until(ms(end_ms)).expect("nothing panics");
        let summary = lockstep.finish();
        let health = summary.node("b").map(|b| (b.health.state, b.health.since));
        health.expect("the node is there")
    };
    assert_eq!(state_at(20), (NodeState::Running, Stamp::ZERO), "from the start");
    assert_eq!(state_at(45), (NodeState::Faulted, ms(30)), "since the first failure, not the last");
    assert_eq!(state_at(80), (NodeState::Running, ms(60)), "since the first step that did not fail");
}

#[test]
fn a_panic_ends_the_run_and_names_node_and_time() {
    let mut lockstep = lockstep(
        "robot: r\nnodes:\n  a: {operator: ticker, period_ms: 10}\n  b: {operator: bomb, inputs: {given: a/ticks}}",
    );
    let error = lockstep.run_until(ms(100)).expect_err("it goes off at 3");
    assert_eq!(error.to_string(), "node `b` panicked at 0.030000000 s of virtual time: tick 3", "the message");
    assert!(matches!(lockstep.run_until(ms(200)), Err(LockstepError::Panicked { .. })), "the run has ended");
    assert_eq!(lockstep.finish().node("a").map(|a| a.steps), Some(4), "what was is still told");
}

#[test]
fn binaries_of_the_users_own_are_named() {
    let binary = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/dataflows/programs/two.sh");
    let graph =
        parse(&format!("robot: r\nnodes: {{mine: {{exec: {binary}, operator: idle}}, a: {{operator: ticker}}}}"));
    let error = Lockstep::new(&graph, LockstepOptions::default()).err().expect("refused").to_string();
    assert!(error.starts_with("`mine` run as binaries of their own"), "{error}");
}

#[test]
fn nodes_that_wake_each_other_for_ever_are_named() {
    let mut lockstep = lockstep("robot: r\nnodes: {a: {operator: insomniac}}");
    let error = lockstep.run_until(ms(1)).expect_err("it never sleeps");
    assert!(matches!(error, LockstepError::StandsStill { ref node, .. } if node == "a"), "{error}");
}

#[test]
fn single_events_lead_to_the_same_bytes() {
    let run = |single: bool| {
        let mut lockstep = lockstep(
            "robot: r\nnodes:\n  a: {operator: ticker, period_ms: 3}\n  b: {operator: relay, inputs: {given: a/ticks}, latency_ms: 2}",
        );
        if single {
            while lockstep.now() < ms(30) {
                assert!(lockstep.step_event().expect("nothing panics").is_some(), "a period always comes");
            }
        }
        lockstep.run_until(ms(31)).expect("nothing panics");
        lockstep.finish().hash
    };
    assert_eq!(run(true), run(false), "step_event and run_until do the same");
}
