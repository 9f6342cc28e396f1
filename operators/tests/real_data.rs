//! The real operators on real pictures, where the data folder is there: a highway video, and the frames of another small car whose
//! driver's steering angles are known. `cargo test -p carril-operators --test real_data -- --nocapture` prints the figures.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use carril_messages::{Image, LaneEstimate, Message, Meta, Origins, Stamp};
use carril_operators::camera::{Camera, CameraOutputs, FrameFiles};
use carril_operators::decision::{DecisionConfig, pursuit};
use carril_operators::lane_detector::survey::{Findings, Survey, Verdict};
use carril_operators::lane_detector::{LaneDetector, LaneDetectorConfig, LaneDetectorInputs, LaneDetectorOutputs};
use carril_operators::lane_lines::{LaneLines, LaneLinesInputs, LaneLinesOutputs};
use carril_runtime::{Context, HeapPool, NoInputs, Operator, Setup, Trigger};
use serde_json::{Value, json};

/// Gains of the decision node, by default.
const K_ANGLE: f64 = 0.9;
const K_DISTANCE_RAD_PER_PX: f64 = 0.005;

/// The data folder; `None`, with a message, where it is absent.
fn data(path: &str) -> Option<PathBuf> {
    let full = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(path);
    if !full.exists() {
        eprintln!("skipped: there is no `{}`", full.display());
        return None;
    }
    Some(full)
}

fn build<O: Operator>(node: &str, config: Value) -> O {
    let config = serde_json::from_value(config).expect("a valid configuration");
    O::new(config, &Setup::for_tests(node)).expect("the operator is built")
}

/// Lets the camera and the lane detector work through a source; one estimate per frame.
fn estimates(source: &str, lane: Value) -> Vec<Arc<LaneEstimate>> {
    let mut camera: Camera = build("camera", json!({ "source": source }));
    let mut detector: LaneDetector = build("lane", lane);
    let (mut images, mut inputs, mut outputs) =
        (CameraOutputs::default(), LaneDetectorInputs::default(), LaneDetectorOutputs::default());
    let mut estimates = Vec::new();
    for frame in 0.. {
        let now = Stamp::from_nanos(frame * 40_000_000);
        let step = camera.step(&mut NoInputs, &mut images, &Context::new(now, Trigger::Period, &HeapPool));
        for image in images.image.sent() {
            let (origins, meta) = (Origins::none(), Meta::new());
            let header =
                carril_messages::Header { epoch: 1, seq: 0, stamp: now, origins, message_type: Image::TYPE, meta };
            inputs.image.put(Image::clone(&image), header);
        }
        detector.step(&mut inputs, &mut outputs, &Context::new(now, Trigger::Input, &HeapPool)).expect("a step");
        estimates.extend(outputs.lane.sent());
        if let Err(end) = step {
            eprintln!("{end}");
            return estimates;
        }
    }
    unreachable!("a file ends")
}

/// What calibration says about the markings of a source.
fn surveyed(path: &Path) -> Findings {
    let mut survey = Survey::new(&LaneDetectorConfig::default()).expect("bright markings");
    for frame in FrameFiles::open(&path.display().to_string()).expect("it can be opened") {
        survey.add(&frame.expect("no frame is damaged"));
    }
    survey.findings()
}

#[test]
fn calibration_finds_a_threshold_on_the_highway_and_none_on_glossy_wood() {
    if let Some(path) = data("road/solidWhiteRight.mp4") {
        let findings = surveyed(&path);
        eprintln!("highway: {:?}", findings.verdict);
        assert!(
            matches!(findings.verdict, Verdict::Divided { threshold: 120..=190, .. }),
            "asphalt is about 95, paint about 240: {findings:?}"
        );
    }
    if let Some(path) = data("picar") {
        let findings = surveyed(&path);
        eprintln!("wood: {:?}", findings.verdict);
        assert!(matches!(findings.verdict, Verdict::Overlap { gap: ..0, .. }), "reflections reach 250: {findings:?}");
    }
}

fn share_with_lane(estimates: &[Arc<LaneEstimate>]) -> f64 {
    estimates.iter().filter(|estimate| estimate.lane.is_some()).count() as f64 / estimates.len() as f64
}

/// Pearson's coefficient.
fn correlation(pairs: &[(f64, f64)]) -> f64 {
    let count = pairs.len() as f64;
    let (mean_x, mean_y) = pairs.iter().fold((0.0, 0.0), |(x, y), pair| (x + pair.0 / count, y + pair.1 / count));
    let sum = |of: fn(f64, f64) -> f64| pairs.iter().map(|(x, y)| of(x - mean_x, y - mean_y)).sum::<f64>();
    sum(|x, y| x * y) / (sum(|x, _| x * x) * sum(|_, y| y * y)).sqrt()
}

#[test]
fn sees_the_lane_of_a_highway() {
    let Some(video) = data("road/solidWhiteRight.mp4") else { return };
    let fixed = estimates(&video.to_string_lossy(), json!({ "threshold": 190, "band_px": 41 }));
    let otsu = estimates(&video.to_string_lossy(), json!({ "threshold": "otsu", "band_px": 41 }));
    let narrow = estimates(&video.to_string_lossy(), json!({ "threshold": 190 }));
    let quality = fixed.iter().map(|estimate| f64::from(estimate.quality)).sum::<f64>() / fixed.len() as f64;
    eprintln!(
        "highway video: {} frames; with a lane: {:.3} (fixed 190, bands of 41 rows, mean quality {quality:.2}), {:.3} (Otsu), \
         {:.3} (fixed 190, bands of 1 row)",
        fixed.len(),
        share_with_lane(&fixed),
        share_with_lane(&otsu),
        share_with_lane(&narrow),
    );
    assert!(fixed.len() >= 200, "the video has 9 s of 25 frames, got {}", fixed.len());
    assert!(share_with_lane(&fixed) >= 0.95, "fixed threshold: {:.3}", share_with_lane(&fixed));
    assert!(share_with_lane(&otsu) >= 0.95, "Otsu: {:.3}", share_with_lane(&otsu));
}

#[test]
fn steers_like_the_driver_of_the_small_car() {
    let Some(folder) = data("picar") else { return };
    // The tape is blue, the light is warm: its hue lies between yellow-green and blue.
    let lane = json!({
        "marking": { "hsv": { "h": [27, 130], "s": [20, 255], "v": [20, 160] } },
        "row_far": 0.6, "row_near": 0.75, "band_px": 9,
    });
    let estimates = estimates(&format!("{}/*.png", folder.display()), lane);
    let mut files: Vec<_> = folder.read_dir().expect("a folder").flatten().map(|entry| entry.path()).collect();
    files.sort();
    assert_eq!(files.len(), estimates.len(), "one estimate per file");
    let pairs: Vec<(f64, f64)> = files
        .iter()
        .zip(&estimates)
        .filter_map(|(file, estimate)| {
            let lane = estimate.lane?;
            let name = file.file_stem()?.to_str()?;
            // The driver's angle: 90 degrees is straight on, less is left.
            let driver_rad = (90.0 - name.rsplit('_').next()?.parse::<f64>().ok()?).to_radians();
            let steering = K_ANGLE * f64::from(lane.angle_rad) + K_DISTANCE_RAD_PER_PX * f64::from(lane.distance_px);
            Some((steering, driver_rad))
        })
        .collect();
    let share = share_with_lane(&estimates);
    let same_side = pairs.iter().filter(|(ours, driver)| ours * driver >= 0.0).count() as f64 / pairs.len() as f64;
    let correlation = correlation(&pairs);
    eprintln!(
        "small car: {} frames, with a lane {share:.3}, same side as the driver {same_side:.3}, correlation with the driver's \
         angle {correlation:.3}",
        estimates.len()
    );
    assert!(share >= 0.95, "frames with a lane: {share:.3}");
    assert!(same_side >= 0.95, "steers to the driver's side: {same_side:.3}");
    assert!(correlation >= 0.85, "correlation with the driver's angle: {correlation:.3}");
}

/// What the small car's driver program did in each frame, rad, + left.
fn driver_rad(files: &[PathBuf]) -> Vec<f64> {
    let angle = |file: &PathBuf| -> Option<f64> { file.file_stem()?.to_str()?.rsplit('_').next()?.parse().ok() };
    // 90 degrees is straight on, less is left.
    files.iter().map(|file| (90.0 - angle(file).expect("the name ends in an angle")).to_radians()).collect()
}

#[test]
fn lines_steer_like_the_driver_of_the_small_car() {
    let Some(folder) = data("picar") else { return };
    // Seen from the camera, which stands for the rear axle; its height is a guess, and everything else is in proportion to it.
    let mut detector: LaneLines = build(
        "lane",
        json!({
            "camera": { "height_m": 0.1, "pitch_deg": 8, "horizontal_fov_deg": 80, "forward_m": 0 },
            "marking": { "hsv": { "h": [27, 130], "s": [20, 255], "v": [20, 160] } },
            "line_width_m": 0.02, "lane_width_m": 0.25, "far_m": 0.7, "min_radius_m": 3,
        }),
    );
    let config = DecisionConfig { lookahead_m: 0.5, max_steering_deg: 45.0, ..DecisionConfig::default() };
    let standing = pursuit::Going { speed_m_s: 0.0, steering_rad: 0.0, age_s: 0.0 };
    let mut files: Vec<_> = folder.read_dir().expect("a folder").flatten().map(|entry| entry.path()).collect();
    files.sort();
    let frames = FrameFiles::open(&format!("{}/*.png", folder.display())).expect("it can be opened");
    let (mut inputs, mut outputs) = (LaneLinesInputs::default(), LaneLinesOutputs::default());
    let mut pairs = Vec::new();
    for (number, (frame, driver_rad)) in frames.zip(driver_rad(&files)).enumerate() {
        let now = Stamp::from_nanos(number as i64 * 40_000_000);
        let (origins, meta) = (Origins::none(), Meta::new());
        let header = carril_messages::Header { epoch: 1, seq: 0, stamp: now, origins, message_type: Image::TYPE, meta };
        inputs.image.put(frame.expect("no frame is damaged"), header);
        detector.step(&mut inputs, &mut outputs, &Context::new(now, Trigger::Input, &HeapPool)).expect("a step");
        let ground = outputs.lane.sent().pop().and_then(|estimate| estimate.lane?.ground);
        let ground = ground.unwrap_or_else(|| panic!("frame {number} has a lane"));
        pairs.push((pursuit::steering_rad(&ground, standing, &config), driver_rad));
    }
    let curves: Vec<_> = pairs.iter().filter(|(_, driver)| driver.abs() > 10_f64.to_radians()).collect();
    let same_side = curves.iter().filter(|(ours, driver)| ours * driver > 0.0).count() as f64 / curves.len() as f64;
    let correlation = correlation(&pairs);
    eprintln!(
        "small car, lines: {} frames, {} in curves, same side there {same_side:.3}, correlation with the driver's angle {correlation:.3}",
        pairs.len(),
        curves.len()
    );
    assert!(same_side >= 0.97, "steers to the driver's side in curves: {same_side:.3}");
    assert!(correlation >= 0.955, "correlation with the driver's angle: {correlation:.3}");
}
