//! The operator as a graph sees it: rates, stamps, determinism, handover, and what it does with bad input.

use crate::rig::{Eye, Rig, Seen, Threshold, follow};
use carril_messages::{McuPins, Pose};
use carril_runtime::{AnyOutput, Context, HeapPool, Operator, Provenance, Setup, Trigger};
use carril_simulator::{SimWorld, SimWorldConfig};

fn rig(seed: u64, camera: bool) -> Rig {
    Rig::new(SimWorldConfig::default(), seed, camera)
}

/// FNV-1a, enough to tell frames apart.
fn hash(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xCBF2_9CE4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01B3))
}

fn run(rig: &mut Rig, steps: u32) -> Vec<Seen> {
    (0..steps).map(|_| rig.step()).collect()
}

#[test]
fn serves_each_output_at_its_rate() {
    let seen = run(&mut rig(1, true), 2000);
    let count = |of: fn(&Seen) -> bool| seen.iter().filter(|seen| of(seen)).count();
    assert_eq!(count(|seen| seen.camera.is_some()), 300, "camera, 30 Hz for 10 s");
    assert_eq!(count(|seen| seen.lane.is_some()), 0, "nobody reads the ideal lane");
    assert_eq!(count(|seen| seen.scan.is_some()), 100, "scans, 10 Hz");
    assert_eq!(count(|seen| seen.sensors.is_some()), 2000, "sensors, each step");
    assert_eq!(count(|seen| seen.vehicle.is_some()), 500, "vehicle, 50 Hz");
    assert_eq!(count(|seen| seen.progress.is_some()), 100, "progress, 10 Hz");
}

#[test]
fn frames_carry_the_time_of_their_exposure() {
    let mut rig = rig(1, true);
    for _ in 0..20 {
        let now = rig.now;
        let context = Context::new(now, Trigger::Period, &HeapPool);
        rig.world.step(&mut rig.inputs, &mut rig.outputs, &context).expect("a step");
        rig.outputs.camera.drain(&mut |outgoing| {
            assert_eq!(outgoing.provenance, Provenance::Captured(now), "exposed in this step");
        });
        rig.now = now + std::time::Duration::from_millis(5);
    }
}

#[test]
fn same_seed_same_bytes() {
    let drive = |seed: u64| {
        let mut rig = rig(seed, true);
        let progress = follow(&mut rig, Eye::Camera { threshold: Threshold::Fixed(190) }, 0.5, 1, 5.0);
        let seen = run(&mut rig, 50);
        let pixels =
            seen.iter().filter_map(|seen| seen.camera.as_ref()).map(|image| hash(image.pixels())).collect::<Vec<_>>();
        let scans =
            seen.iter().filter_map(|seen| seen.scan.as_ref()).map(|scan| format!("{scan:?}")).collect::<Vec<_>>();
        (pixels, scans, format!("{progress:?}"))
    };
    let first = drive(7);
    assert_eq!(first, drive(7), "same seed");
    assert_ne!(first.0, drive(8).0, "another seed of the run, other noise in the camera");
    assert_ne!(first.1, drive(8).1, "and in the lidar");
}

#[test]
fn an_output_that_nobody_reads_changes_no_other() {
    let mut with = rig(1, true);
    let mut without = rig(1, false);
    let scans = |seen: Vec<Seen>| {
        seen.into_iter().filter_map(|seen| seen.scan).map(|scan| format!("{scan:?}")).collect::<Vec<_>>()
    };
    assert_eq!(scans(run(&mut with, 100)), scans(run(&mut without, 100)), "scans with and without a camera");
}

/// Renew after a deliberate change of the picture: the failing test prints the new value.
#[test]
fn a_frame_is_golden() {
    let image = rig(1, true).step().camera.expect("the first step has a frame");
    assert_eq!((image.width(), image.height(), image.pixels().len()), (640, 480, 640 * 480 * 3), "size");
    assert_eq!(
        format!("{:016x}", hash(image.pixels())),
        "14d47d7b85eb461e",
        "the first frame on the oval with seeds 1 and 1"
    );
}

#[test]
fn a_frame_shows_floor_and_markings_where_geometry_says() {
    let mut config = SimWorldConfig::default();
    config.camera.noise_grey = 0.0;
    let model = config.camera.model();
    let image = Rig::new(config, 1, true).step().camera.expect("a frame");
    let grey = |column: f64, row: u32| image.row(row)[column.round() as usize * 3];
    for row in [330, 360, 408, 470] {
        let per_px = model.ground_row(f64::from(row)).expect("below the horizon").metres_per_px;
        for side in [-1.0, 1.0] {
            let column = |left_m: f64| model.middle_column() - side * left_m / per_px;
            assert_eq!(grey(column(0.200), row), 230, "middle of the marking, row {row}, side {side}");
            assert_eq!(grey(column(0.185), row), 60, "inside of the marking, row {row}, side {side}");
            assert_eq!(grey(column(0.215), row), 60, "outside of the marking, row {row}, side {side}");
        }
    }
    assert_eq!(grey(320.0, 100), 40, "above the horizon is the room");
}

#[test]
fn a_box_stands_in_the_picture_and_in_the_scan() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = "\
lane: { centre: { points: [[0, 0], [4, 0], [4, 4], [0, 4]] } }
boxes: [{ x_m: 2.0, y_m: 0.0, length_m: 0.4, width_m: 0.4, height_m: 0.2, colour: [255, 0, 0] }]
start: { x_m: 0.5, y_m: 0.0, yaw_deg: 0 }
";
    std::fs::write(folder.path().join("box.yaml"), text).expect("written");
    let mut config =
        SimWorldConfig { track: folder.path().join("box.yaml").display().to_string(), ..SimWorldConfig::default() };
    config.camera.noise_grey = 0.0;
    config.lidar.noise_m = 0.0;
    config.lidar.dropout = 0.0;
    let model = config.camera.model();
    let mut rig = Rig::new(config, 1, true);
    let seen = rig.step();
    let (image, scan) = (seen.camera.expect("a frame"), seen.scan.expect("a scan"));
    // The front face is 1.3 m ahead of the rear axle; its middle is 0.1 m high.
    let pixel = model.project(model.from_body(nalgebra::Point3::new(1.3, 0.0, 0.1)));
    let bgr = &image.row(pixel.y as u32)[pixel.x as usize * 3..][..3];
    assert!(bgr[0] == 0 && bgr[1] == 0 && bgr[2] > 100, "a red face, got {bgr:?}");
    assert!(
        (scan.ranges_m[180] - (1.3 - 0.18)).abs() < 1e-4,
        "the lidar stands 0.18 m ahead, got {} m",
        scan.ranges_m[180]
    );
    // Driving on, the car runs into it and stays before it.
    rig.command(0.0, 0.5);
    let last = run(&mut rig, 2000).into_iter().filter_map(|seen| seen.progress).next_back().expect("progress");
    assert_eq!(last.collisions, 1, "one contact");
    assert!((last.distance_m - 1.0).abs() < 0.01, "1.3 m less 0.30 m of nose, got {} m", last.distance_m);
}

#[test]
fn pins_drive_and_win_over_a_command() {
    let mut rig = rig(1, false);
    rig.command(0.0, -0.5);
    rig.pins(McuPins { servo_us: Some(1050), motor_duty: 0.3, brake: false });
    let state = run(&mut rig, 400).into_iter().filter_map(|seen| seen.vehicle).next_back().expect("a state");
    assert!(state.speed_m_s > 0.4, "forward, as the pins say: {state:?}");
    assert!(state.steering_rad.abs() < 1e-6, "1050 us is straight: {state:?}");
}

#[test]
fn what_is_not_a_number_is_refused_and_changes_nothing() {
    let mut rig = rig(1, false);
    rig.command(0.0, 0.5);
    run(&mut rig, 400);
    rig.command(f64::NAN, 0.5);
    let context = Context::new(rig.now, Trigger::Period, &HeapPool);
    let error = rig.world.step(&mut rig.inputs, &mut rig.outputs, &context).expect_err("NaN is refused");
    assert!(error.to_string().contains("not finite"), "{error}");
    rig.now = rig.now + std::time::Duration::from_millis(5);
    let state = run(&mut rig, 100).into_iter().filter_map(|seen| seen.vehicle).next_back().expect("a state");
    assert!((state.speed_m_s - 0.5).abs() < 1e-3, "goes on as before: {state:?}");
}

#[test]
fn a_successor_goes_on_where_the_predecessor_stopped() {
    let mut first = rig(1, true);
    follow(&mut first, Eye::Camera { threshold: Threshold::Fixed(190) }, 0.5, 1, 3.0);
    let mut second = rig(1, true);
    second.world.restore(first.world.snapshot()).expect("the same version");
    second.now = first.now;
    for step in 0..200 {
        let (a, b) = (first.step(), second.step());
        assert_eq!(
            a.camera.map(|image| hash(image.pixels())),
            b.camera.map(|image| hash(image.pixels())),
            "frame of step {step}"
        );
        assert_eq!(a.sensors, b.sensors, "sensors of step {step}");
    }
}

#[test]
fn presses_the_estop_button_on_time() {
    let config = SimWorldConfig { estop_pressed_s: vec![[0.1, 0.2]], ..SimWorldConfig::default() };
    let seen = run(&mut Rig::new(config, 1, false), 100);
    let pressed = seen.iter().filter(|seen| seen.sensors.as_ref().is_some_and(|sensors| sensors.estop_pressed)).count();
    assert_eq!(pressed, 20, "100 ms of 5 ms steps");
}

#[test]
fn a_pause_of_the_computer_stops_the_world_not_the_car() {
    let mut rig = rig(1, false);
    rig.command(0.0, 0.5);
    run(&mut rig, 400);
    let before =
        run(&mut rig, 20).into_iter().filter_map(|seen| seen.progress).next_back().expect("progress").distance_m;
    rig.now = rig.now + std::time::Duration::from_secs(60);
    let after =
        run(&mut rig, 40).into_iter().filter_map(|seen| seen.progress).next_back().expect("progress").distance_m;
    assert!(after - before < 0.5, "a minute's pause is not driven blindly: {} m", after - before);
}

#[test]
fn starts_where_the_configuration_says() {
    let mut config = SimWorldConfig::default();
    config.start.left_m = 0.1;
    config.start.along_m = 1.0;
    config.start.yaw_deg = 10.0;
    let state = Rig::new(config, 1, false).step().vehicle.expect("the first step has a state");
    let Pose { x_m, y_m, yaw_rad } = state.pose_in_map;
    assert!((x_m - 1.0).abs() < 0.02 && (y_m - 0.1).abs() < 1e-3, "({x_m}, {y_m})");
    assert!((yaw_rad - 10_f64.to_radians()).abs() < 1e-3, "yaw {yaw_rad}");
}

#[test]
fn a_missing_track_is_an_error_of_the_build() {
    let config = SimWorldConfig { track: "nowhere.yaml".into(), ..SimWorldConfig::default() };
    let error = SimWorld::new(config, &Setup::for_tests("world")).err().expect("no such track").to_string();
    assert!(error.starts_with("nowhere.yaml: cannot read"), "{error}");
}
