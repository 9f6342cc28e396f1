//! `carril watch`, `params`, `get` and `set` on the default graph while the car drives, from the command line.

mod support;

use std::io::Write;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use carril_messages::{Header, LaneEstimate, Message, Payload};
use carril_runtime::client::find_run;
use carril_runtime::control_plane::receipts_key;
use carril_runtime::transport::zenoh::{ZenohOptions, ZenohTransport};
use serde_json::Value;
use support::car::{Car, Ears, bad_program, kill_at_once, patient_graph, processes, until};
use support::{Running, program};

/// The threshold that an estimate was made with.
fn threshold(header: &Header, payload: &Payload) -> Option<u8> {
    LaneEstimate::decode(&header.meta, payload).expect("an estimate").threshold
}

/// What `carril get` says.
#[track_caller]
fn get(car: &Car, path: &str) -> String {
    car.sandbox.carril(&["get", "lane", path]).expect(0).trim().to_owned()
}

#[track_caller]
fn until_threshold(estimates: &Ears<Option<u8>>, wanted: u8) {
    until("estimates with the new threshold", || estimates.last() == Some(Some(wanted)));
}

#[test]
fn a_parameter_is_listed_read_and_set_while_the_car_drives() {
    let car = Car::launch(&patient_graph(&[]));
    let estimates = car.hear("lane/lane", threshold);
    let listed: Value =
        serde_json::from_str(&car.sandbox.carril(&["params", "lane", "--json"]).expect(0)).expect("JSON");
    let paths: Vec<&str> = listed.as_array().into_iter().flatten().filter_map(|row| row["path"].as_str()).collect();
    assert!(["threshold", "row_far", "row_near"].iter().all(|path| paths.contains(path)), "{paths:?}");
    assert_eq!(get(&car, "threshold"), "190", "as the graph file has it");

    let told = car.sandbox.carril(&["set", "lane", "threshold=180"]).expect(0);
    assert!(told.contains("threshold 190 -> 180") && told.contains("version 2"), "{told}");
    until_threshold(&estimates, 180);
    assert_eq!(get(&car, "threshold"), "180", "in force");

    for (values, says) in [
        ("threshold=300", "allowed is 0 to 255"),
        ("threshold=.nan", "threshold"),
        ("threshhold=3", "did you mean `threshold`?"),
        ("row_far=0.9", "row_near"),
    ] {
        let outcome = car.sandbox.carril(&["set", "lane", values]);
        assert!(matches!(outcome.code, Some(1 | 2)), "{values}: refused: {}", outcome.report());
        assert!(outcome.stderr.contains(says), "{values}: `{says}` in: {}", outcome.report());
    }
    let nobody = car.sandbox.carril(&["set", "lame", "threshold=3"]).expect_error(1);
    assert!(nobody.contains("did you mean `lane`?"), "{nobody}");
    assert_eq!((get(&car, "threshold"), get(&car, "row_far")), ("180".into(), "0.75".into()), "nothing has changed");
    car.assert_in_the_lane();
    car.end();
}

#[test]
fn two_values_come_into_force_together_or_not_at_all() {
    let car = Car::launch(&patient_graph(&[]));
    let both = || (get(&car, "row_far"), get(&car, "row_near"));
    let refused = car.sandbox.carril(&["set", "lane", "row_far=0.7,row_near=7"]).expect_error(1);
    assert!(refused.contains("row_near"), "{refused}");
    assert_eq!(both(), ("0.75".into(), "0.85".into()), "the good one has not come into force alone");
    // Each alone would be refused: the far row would be nearer than the near one.
    car.sandbox.carril(&["set", "lane", "row_far=0.86,row_near=0.92"]).expect(0);
    assert_eq!(both(), ("0.86".into(), "0.92".into()), "together");
    car.sandbox.carril(&["set", "lane", "row_far=0.75,row_near=0.85"]).expect(0);
    car.assert_in_the_lane();
    car.end();
}

#[test]
fn a_saved_value_leaves_the_rest_of_the_file_as_it_is() {
    let car = Car::launch(&patient_graph(&[]));
    let before = std::fs::read_to_string(car.graph_file()).expect("it was written");
    let told = car.sandbox.carril(&["set", "lane", "threshold=175", "row_far=0.7", "--save"]).expect(0);
    assert!(told.contains("saved in"), "{told}");
    let expected = before.replace("threshold: 190, row_far: 0.75", "threshold: 175, row_far: 0.7");
    let after = std::fs::read_to_string(car.graph_file()).expect("it is there");
    assert_ne!(after, before, "it was saved");
    assert_eq!(after, expected, "comments, order and style stay");
    assert_eq!(get(&car, "threshold"), "175", "and in force");

    car.sandbox.carril(&["set", "lane", "threshold=999", "--save"]).expect_error(1);
    let unchanged = std::fs::read_to_string(car.graph_file()).expect("it is there");
    assert_eq!((unchanged, get(&car, "threshold")), (expected, "175".into()), "what is refused is not saved");
    car.end();
}

/// What kills itself again and again is given up after one more life.
const GIVES_UP_SOON: (&str, &str) = ("    deadline_ms: 1000\n", "    deadline_ms: 1000\n    restart: { max: 1 }\n");

#[test]
fn a_node_that_gave_up_is_started_again_by_hand() {
    let car = Car::launch(&patient_graph(&[GIVES_UP_SOON]));
    let (mark, estimates) = (car.mark(), car.hear("lane/lane", threshold));
    let process = |name: &str| processes(&car.sandbox).into_iter().find(|(_, known)| known == name).map(|(pid, _)| pid);
    let mut last = None;
    for _ in 0..2 {
        until("a life of it", || process("lane").is_some_and(|pid| Some(pid) != last));
        last = process("lane");
        kill_at_once(last.expect("it was waited for"));
    }
    let gave_up = r#""kind":"gave-up","nodes":["lane"]"#;
    until("the run says that it is given up", || car.said_since(mark, gave_up));
    for command in [&["set", "lane", "threshold=180"][..], &["shadow", "lane"]] {
        let refused = car.sandbox.carril(command);
        let said = format!("{}{}", refused.stdout, refused.stderr);
        assert_eq!(refused.code, Some(1), "{command:?}: {said}");
        assert!(said.contains("gave up") && said.contains("carril restart lane"), "{command:?}: {said}");
    }
    let told = car.sandbox.carril(&["restart", "lane"]).expect(0);
    assert!(told.starts_with("lane: restart done, in force after") && told.contains("it gave up"), "{told}");
    estimates.wait_for(10);
    assert_eq!(get(&car, "threshold"), "190", "the same version");
    let told = car.sandbox.carril(&["restart", "lane", "--fresh"]).expect(0);
    assert!(told.starts_with("lane: restart done"), "one that runs: {told}");
    // Also that it was given up once is mended: the run ends well.
    car.end();
}

/// Hears every receipt of a run, as a program of somebody else would.
fn hear_receipts(car: &Car) -> (Arc<Mutex<Vec<Value>>>, (ZenohTransport, carril_runtime::transport::Guard)) {
    let run = find_run(&car.sandbox.path().join("runs"), None).expect("it runs");
    let connect = vec![run.endpoint];
    let transport = ZenohTransport::open(ZenohOptions { connect, ..ZenohOptions::default() }).expect("a session");
    let receipts: Arc<Mutex<Vec<Value>>> = Arc::default();
    let heard = Arc::clone(&receipts);
    let guard = transport.watch(&receipts_key(&run.robot), move |_, _, payload| {
        let receipt = serde_json::from_slice(&payload).expect("JSON");
        heard.lock().unwrap_or_else(PoisonError::into_inner).push(receipt);
    });
    until("the supervisor can be reached", || transport.links() > 0);
    (receipts, (transport, guard.expect("subscribing")))
}

#[test]
fn each_change_is_published_and_logged() {
    let car = Car::launch(&patient_graph(&[]));
    let (receipts, _link) = hear_receipts(&car);
    let heard = |what: &str, outcome: &str| {
        let receipts = receipts.lock().unwrap_or_else(PoisonError::into_inner);
        receipts.iter().any(|receipt| receipt["what"] == what && receipt["outcome"] == outcome)
    };
    let mark = car.mark();
    // The subscription is known to the supervisor at the latest when it has answered a later question of ours.
    until("the first receipt is heard", || {
        car.sandbox.carril(&["set", "lane", "threshold=180"]).expect(0);
        heard("set", "done")
    });
    car.swap(&["lane", "--set", "threshold=185", "--shadow", "50ms"]);
    car.change(&["swap", "lane", "--set", "threshold=300"]);
    for (what, outcome) in [("swap", "done"), ("swap", "refused")] {
        until(&format!("{what} {outcome} is published"), || heard(what, outcome));
        let logged = || {
            let (stdout, _) = car.run.output();
            stdout[mark.0..].lines().filter_map(|line| serde_json::from_str::<Value>(line).ok()).any(|line| {
                let receipt = &line["event"]["receipt"];
                receipt["what"] == what && receipt["outcome"] == outcome
            })
        };
        until(&format!("{what} {outcome} is shown by `carril run`"), logged);
    }
    car.end();
}

/// `carril watch lane` at work, from when on every new build is seen.
fn watch(car: &Car, path: &Path) -> Running {
    let mut watch = car.sandbox.start(&["watch", "lane", "--exec", &path.display().to_string()]);
    watch.wait_for_output("it watches", |output| output.contains("watching"));
    watch
}

/// How the swaps of a watch came out: `done, in force ...`, `refused, ...`.
fn outcomes(watch: &Running) -> Vec<String> {
    let (stdout, _) = watch.output();
    // The last line may be half written.
    let lines = stdout.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    lines.filter_map(|line| line.strip_prefix("lane: swap ")).map(str::to_owned).collect()
}

/// A finished build appears at once.
fn build(path: &Path, content: &[u8]) {
    let fresh = path.with_extension("fresh");
    std::fs::write(&fresh, content).expect("the sandbox is writable");
    make_executable(&fresh);
    std::fs::rename(fresh, path).expect("the sandbox is writable");
}

fn make_executable(path: &Path) {
    use std::os::unix::fs::PermissionsExt;
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).expect("ours");
}

fn runs_binary(car: &Car) -> Option<String> {
    let info: Value = serde_json::from_str(&car.sandbox.carril(&["info", "lane", "--json"]).expect(0)).expect("JSON");
    info["node"]["exec"].as_str().map(str::to_owned)
}

#[test]
fn a_watched_build_is_swapped_in_and_a_failing_one_changes_nothing() {
    let car = Car::launch(&patient_graph(&[]));
    let path = car.sandbox.path().join("my-lane");
    let watch = watch(&car, &path);
    let good = std::fs::read(program("my-lane")).expect("it was built");
    let next_is = |what: &str, number: usize, outcome: &str| {
        until(what, || outcomes(&watch).len() >= number);
        let said = watch.output();
        assert!(outcomes(&watch)[number - 1].starts_with(outcome), "{what}: {outcome}: {said:?}");
    };
    build(&path, &good);
    next_is("the first build", 1, "done");
    let first = runs_binary(&car);
    assert!(first.as_ref().is_some_and(|exec| exec.ends_with("/my-lane")), "the binary runs: {first:?}");

    build(&path, b"no program at all");
    next_is("no program", 2, "refused");
    // Not half of it: what is behind the code and the data is not missed.
    build(&path, &good[..good.len() / 20]);
    next_is("a part of a program", 3, "refused");
    let dies = std::fs::read(bad_program(&car.sandbox, "dies-at-start")).expect("it was built");
    build(&path, &dies);
    next_is("a program with several operators", 4, "refused");
    assert_eq!(runs_binary(&car), first, "the first build goes on");

    build(&path, &good);
    next_is("the mended build", 5, "done");
    watch.interrupt().expect(0);
    assert!(runs_binary(&car).is_some_and(|exec| exec.ends_with("/my-lane")), "what went through stays");
    car.end();
}

/// Closes the file again: one that is open for writing could not be started, which would protect it. One that was started too early
/// cannot be written to until it has ended.
fn append(path: &Path, part: &[u8]) {
    let open = || std::fs::OpenOptions::new().create(true).append(true).open(path);
    let mut opened = open();
    while opened.as_ref().is_err_and(|error| error.kind() == std::io::ErrorKind::ExecutableFileBusy) {
        std::thread::sleep(Duration::from_millis(5));
        opened = open();
    }
    opened.and_then(|mut file| file.write_all(part)).expect("the sandbox is writable");
    make_executable(path);
}

/// Writes a file bit by bit, as a linker does. The longest pause between two writes.
fn write_slowly(path: &Path, content: &[u8]) -> Duration {
    let (mut last, mut longest) = (Instant::now(), Duration::ZERO);
    for part in content.chunks(content.len() / 100 + 1) {
        std::thread::sleep(Duration::from_millis(30));
        longest = longest.max(last.elapsed());
        append(path, part);
        last = Instant::now();
    }
    longest
}

#[test]
fn a_build_that_takes_a_while_to_be_written_is_not_taken_half() {
    let car = Car::launch(&patient_graph(&[]));
    let path = car.sandbox.path().join("my-lane");
    let watch = watch(&car, &path);
    let good = std::fs::read(program("my-lane")).expect("it was built");
    // On a busy machine the writer itself may pause for as long as a finished build rests: that shows nothing, so it is written again.
    let rest = Duration::from_millis(150);
    for _ in 0..5 {
        let before = outcomes(&watch).len();
        let longest = write_slowly(&path, &good);
        let new = || outcomes(&watch).split_off(before);
        until("it is swapped in", || new().iter().any(|outcome| outcome.starts_with("done")));
        if longest < rest {
            assert_eq!(new().len(), 1, "once, and whole: {:?}", watch.output());
            break;
        }
        std::fs::remove_file(&path).expect("ours");
    }
    watch.interrupt().expect(0);
    car.end();
}
