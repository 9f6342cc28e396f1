//! Track files that are wrong: every problem with its place, and never a panic.

use std::path::Path;

use carril_runtime::{Findings, OperatorConfig};
use carril_simulator::SimWorldConfig;
use carril_simulator::track::Track;

/// What is said about a file, line by line.
fn complaints(text: &str) -> Vec<String> {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("bad.yaml"), text).expect("written");
    std::fs::write(folder.path().join("not-a-picture.png"), "this is no picture").expect("written");
    image::GrayImage::new(1, 1).save(folder.path().join("tiny.png")).expect("written");
    match Track::load("bad.yaml", folder.path()) {
        Ok(_) => Vec::new(),
        Err(error) => {
            let shown = folder.path().display().to_string();
            error.lines().map(|(line, _)| line.replace(&shown, "FOLDER")).collect()
        }
    }
}

#[test]
fn reports_every_problem_with_its_place() {
    let text = "\
lane:
  width_m: .nan
  centre:
    pieces:
      - straight_m: -2
      - left: { radius_m: 0, angle_deg: 180 }
      - right: { radius_m: 1, angle_deg: 1000 }
boxes:
  - { x_m: 1e9, y_m: 0, length_m: 0.2, width_m: 0.2, colour: [1, 2, 300] }
walls:
  - { from: [0, 0], to: [0, 0] }
  - { from: [0], to: [1, .inf] }
start: { x_m: 1, along_m: 2 }
";
    insta::assert_snapshot!(complaints(text).join("\n"));
}

#[test]
fn reports_bad_traffic_lights() {
    let lane = "lane: { centre: { points: [[0, 0], [4, 0], [4, 4], [0, 4]] } }\n";
    let mut all = complaints(&format!(
        "{lane}lights:\n  - {{ along_m: -1, height_m: 0, line_width_m: .nan, phases: [red: 0, green: .inf] }}\n  - {{ along_m: 1, phases: [] }}\n"
    ));
    all.extend(complaints(&format!("{lane}lights: [{{ along_m: 1, phases: [blue: 1] }}]\n")));
    all.extend(complaints(&format!("{lane}lights: [{{ along_m: 1 }}]\n")));
    let picture = "floor: { image: tiny.png, width_m: 12, height_m: 12 }\nstart: { x_m: 1, y_m: 1 }\n";
    all.extend(complaints(&format!("{picture}lights: [{{ along_m: 1, phases: [red: 1] }}]\n")));
    insta::assert_snapshot!(all.join("\n"));
}

#[test]
fn reports_an_open_centre_line() {
    let text = "lane:\n  centre:\n    pieces: [straight_m: 2, left: { radius_m: 1, angle_deg: 180 }, straight_m: 1]\n";
    insta::assert_snapshot!(complaints(text).join("\n"));
}

#[test]
fn reports_too_few_repeated_and_cramped_points() {
    let mut all = complaints("lane: { centre: { points: [[0, 0], [1, 1]] } }");
    all.extend(complaints("lane: { centre: { points: [[0, 0], [1, 1], [2, 0], [0, 0]] } }"));
    all.extend(complaints("lane: { centre: { points: [[0, 0], [0.3, 0], [0.3, 0.1], [0, 0.1]] } }"));
    all.extend(complaints("lane: { centre: { points: [[0, 0, 0], [.nan, 1], [2, 0]] } }"));
    insta::assert_snapshot!(all.join("\n"));
}

#[test]
fn reports_bad_pictures() {
    let mut all = complaints("floor: { image: missing.png, width_m: 12, height_m: 12 }\nstart: { x_m: 1, y_m: 1 }");
    all.extend(complaints("floor: { image: not-a-picture.png, width_m: 12, height_m: 0 }\nstart: { x_m: 1, y_m: 1 }"));
    all.extend(complaints("floor: { image: tiny.png, width_m: 12 }\n"));
    insta::assert_snapshot!(all.join("\n"));
}

#[test]
fn reports_yaml_and_schema_errors_at_their_place() {
    let mut all = complaints("lane: [");
    all.extend(complaints("lane:\n  centre: { pieces: [] }\n  widht_m: 0.4\n"));
    all.extend(complaints("lane:\n  centre: { pieces: [{ straight_m: many }] }\n"));
    all.extend(complaints(""));
    all.extend(complaints("a: &a [*a, *a]"));
    insta::assert_snapshot!(all.join("\n"));
}

#[test]
fn a_picture_that_breaks_off_is_an_error_of_the_build_with_its_place() {
    use carril_runtime::{Operator as _, Setup};
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("floor.png");
    image::GrayImage::from_fn(300, 300, |x, y| image::Luma([(x ^ y) as u8])).save(&path).expect("saved");
    let bytes = std::fs::read(&path).expect("read");
    std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("written");
    let text = "floor:\n  image: floor.png\n  width_m: 3\n  height_m: 3\nstart: { x_m: 1, y_m: 1 }\n";
    std::fs::write(folder.path().join("half.yaml"), text).expect("written");
    let config = SimWorldConfig { track: "half.yaml".into(), ..SimWorldConfig::default() };
    let setup = Setup { base_dir: folder.path().into(), ..Setup::for_tests("world") };
    let error = carril_simulator::SimWorld::new(config, &setup).err().expect("half a picture").to_string();
    assert!(error.starts_with("half.yaml:2:10: ") && error.contains("is damaged"), "{error}");
}

#[test]
fn the_check_of_a_graph_reports_a_bad_track_and_bad_numbers() {
    let mut config = SimWorldConfig { track: "nowhere.yaml".into(), ..SimWorldConfig::default() };
    config.camera.height_m = f64::NAN;
    config.lidar.points = 0;
    config.estop_pressed_s = vec![[3.0, 2.0]];
    let mut findings = Findings::new(Path::new("."), false);
    config.check(&mut findings);
    let found: Vec<String> = findings.into_found().iter().map(|finding| finding.path.join(".")).collect();
    assert_eq!(found, ["estop_pressed_s.0", "camera.height_m", "lidar.points", "track"], "each at its field");
}

#[test]
fn a_start_inside_a_box_is_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = "lane: { centre: { points: [[0, 0], [3, 0], [3, 3], [0, 3]] } }\nboxes: [{ x_m: 0, y_m: 0, length_m: 0.2, width_m: 0.2 }]\n";
    std::fs::write(folder.path().join("blocked.yaml"), text).expect("written");
    let config = SimWorldConfig { track: "blocked.yaml".into(), ..SimWorldConfig::default() };
    let mut findings = Findings::new(folder.path(), false);
    config.check(&mut findings);
    let found = findings.into_found();
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!(found[0].message, "the car would start inside a box or a wall", "the message");
}

#[test]
fn good_names_pass() {
    for track in ["oval", "s-bends", "random:17", "../tracks/oval.yaml", "../tracks/s-bends.yaml"] {
        let config = SimWorldConfig { track: track.into(), ..SimWorldConfig::default() };
        let mut findings = Findings::new(Path::new(env!("CARGO_MANIFEST_DIR")), false);
        config.check(&mut findings);
        let found = findings.into_found();
        assert!(found.is_empty(), "{track}: {found:?}");
    }
}

#[test]
fn random_bytes_never_panic() {
    let mut state = 1_u64;
    let good = include_str!("../../../tracks/oval.yaml").as_bytes();
    for _ in 0..300 {
        let mut bytes = good.to_vec();
        for _ in 0..6 {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let index = (state >> 33) as usize % bytes.len();
            bytes[index] = (state >> 24) as u8 & 0x7F;
        }
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("bad.yaml"), &bytes).expect("written");
        let _ = Track::load("bad.yaml", folder.path());
    }
}
