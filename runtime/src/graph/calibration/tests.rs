use serde_json::json;

use super::*;

fn record() -> Record {
    let figures = json!({ "frames": 60, "floor_p995": 62 }).as_object().cloned().expect("a map");
    let how = How { command: "carril calibrate lane --save".into(), figures };
    Record { when: "2026-11-25T23:10:00Z".into(), what: Subject::Lane, how }
}

fn threshold(value: i32) -> Map<String, Value> {
    Map::from_iter([("threshold".to_owned(), json!(value))])
}

fn written(text: &str, value: i32) -> String {
    edit_calibration(text, "lane", &threshold(value), &record()).unwrap_or_else(|error| panic!("{error} in\n{text}"))
}

#[test]
fn a_new_file_has_the_value_and_the_record() {
    let text = written("", 187);
    let expected = "
nodes:
  lane: { threshold: 187 }
records:
  - when: \"2026-11-25T23:10:00Z\"
    what: lane
    how:
      command: \"carril calibrate lane --save\"
      figures: { floor_p995: 62, frames: 60 }
";
    assert!(text.starts_with("# What is different") && text.ends_with(expected), "{text}");
}

#[test]
fn comments_order_and_other_values_stay() {
    let text = "# my car\nnodes:\n  sectors: { mounting_deg: 180 }   # backwards\n  lane:\n    threshold: 150   # old\n    row_far: 0.7\n# the end\n";
    let once = written(text, 187);
    assert!(once.starts_with(&text.replace("150", "187")), "only the number has changed:\n{once}");
    let twice = written(&once, 190);
    assert!(twice.contains("threshold: 190   # old") && twice.matches("- when:").count() == 2, "{twice}");
    let after = edit_calibration(&twice, "front", &Map::from_iter([("a.b".to_owned(), json!(1))]), &record());
    let after = after.expect("a node that was not there");
    assert!(after.contains("\n  front: { a: { b: 1 } }"), "{after}");
    assert!(after.matches("- when:").count() == 3 && after.contains("# the end"), "{after}");
}

#[test]
fn records_come_behind_the_last_in_every_style() {
    let one = "{ when: \"2026-01-01T00:00:00Z\", what: servo, how: { command: x } }";
    for records in [
        String::new(),
        "records:\n".into(),
        "records:   # of this car\n".into(),
        "records: []\n".into(),
        format!("records: [{one}]   # all\n"),
        format!("records:\n- {one}   # first\n# behind\n"),
        "records:\n    - when: \"2026-01-01T00:00:00Z\"\n      what: servo\n      how: { command: x }\nnodes: { lane: {} }\n".into(),
    ] {
        let text = written(&records.clone(), 187);
        assert!(text.contains("calibrate lane --save"), "{records}\n=>\n{text}");
        for comment in ["# of this car", "# all", "# first", "# behind"] {
            assert_eq!(records.contains(comment), text.contains(comment), "`{comment}` stays:\n{text}");
        }
        written(&text, 188);
    }
    let windows = written("nodes:\r\n  lane: { threshold: 1 }\r\n", 2);
    assert!(!windows.replace("\r\n", "").contains('\n'), "line ends stay those of Windows: {windows:?}");
    let only_record = edit_calibration("", "mcu", &Map::new(), &record()).expect("no value");
    assert!(only_record.contains("records:\n  - when:") && !only_record.contains("nodes:"), "{only_record}");
}

#[test]
fn what_cannot_be_kept_whole_is_refused() {
    for (text, says) in [
        ("nodes: [", "not valid YAML"),
        ("nodes: &all { lane: { threshold: 1 } }\n", "anchor"),
        ("records: 3\n", "no list"),
        ("- 1\n", "list"),
        ("nodes: { lane: 7 }\nrecords: none\n", ""),
    ] {
        let error = edit_calibration(text, "lane", &threshold(5), &record()).expect_err("refused").to_string();
        assert!(error.contains(says), "{text}: `{says}` in `{error}`");
    }
}

#[test]
fn a_file_is_replaced_in_one_step_and_never_over_somebody_elses_work() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("car1.calibration.yaml");
    let prepare = |value| CalibrationFile::prepare(&path, "lane", &threshold(value), &record());
    let first = prepare(187).expect("a new file");
    assert!(!path.exists(), "nothing is written yet");
    first.save().expect("it can be written");
    assert!(std::fs::read_to_string(&path).is_ok_and(|text| text.contains("threshold: 187")), "written");
    assert!(first.save().expect_err("it is there now").to_string().contains("somebody has changed"), "not twice");
    let second = prepare(190).expect("it is there");
    std::fs::write(&path, "nodes: {}\n").expect("writable");
    assert!(second.save().expect_err("changed meanwhile").to_string().contains("somebody has changed"), "refused");
    assert_eq!(std::fs::read_to_string(&path).expect("there"), "nodes: {}\n", "the other one's work stays");
    std::fs::write(&path, "nodes: {").expect("writable");
    assert!(prepare(1).is_err(), "a broken file is not written over");
    assert_eq!(std::fs::read_dir(folder.path()).expect("there").count(), 1, "nothing is left over");
}

#[test]
fn a_record_of_now_has_a_time_in_utc() {
    let record = Record::now(Subject::Lidar, "carril calibrate lidar".into(), Map::new());
    assert!(record.when.ends_with('Z') && humantime::parse_rfc3339(&record.when).is_ok(), "{}", record.when);
}
