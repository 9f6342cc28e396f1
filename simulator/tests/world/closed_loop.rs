//! The simulator under the lane follower's control law: gains 0.9 and 0.005 rad/px, rows 75 % and 85 %, 0.5 m/s, 20 degrees.

use crate::rig::{Eye, Rig, Threshold, follow};
use crate::thorough;
use carril_messages::TrackProgress;
use carril_simulator::SimWorldConfig;
use carril_simulator::camera::light::Lighting;

const FIXED: Eye = Eye::Camera { threshold: Threshold::Fixed(190) };
const OTSU: Eye = Eye::Camera { threshold: Threshold::OtsuOfRow };

fn drive(track: &str, eye: Eye, lighting: Lighting, laps: u32) -> TrackProgress {
    let mut config = SimWorldConfig { track: track.into(), ..SimWorldConfig::default() };
    config.camera.lighting = lighting;
    let mut rig = Rig::new(config, 1, eye != Eye::IdealLane);
    follow(&mut rig, eye, 0.5, laps, 70.0 * f64::from(laps))
}

fn keeps_the_lane(track: &str, eye: Eye, lighting: Lighting, laps: u32) {
    let progress = drive(track, eye, lighting, laps);
    println!(
        "{track}: {eye:?} {lighting:?}: {} laps, rms {:.1} mm, max {:.1} mm",
        progress.laps,
        1e3 * progress.cross_track_rms_m,
        1e3 * progress.cross_track_max_m
    );
    assert_eq!(progress.laps, laps, "{track} with {eye:?}: laps driven; {progress:?}");
    assert_eq!(progress.departures, 0, "{track} with {eye:?}: wheels beyond the markings; {progress:?}");
    assert!(progress.cross_track_rms_m <= 0.05, "{track} with {eye:?}: rms {} m", progress.cross_track_rms_m);
}

#[test]
fn holds_the_oval_by_camera() {
    keeps_the_lane("oval", FIXED, Lighting::Even, thorough::count(1, 2));
}

#[test]
fn holds_the_s_bends_by_camera() {
    keeps_the_lane("s-bends", FIXED, Lighting::Even, thorough::count(1, 2));
}

#[test]
fn holds_both_tracks_in_dim_light_with_a_threshold_per_row() {
    keeps_the_lane("oval", OTSU, Lighting::DimGradient, 1);
    keeps_the_lane("s-bends", OTSU, Lighting::DimGradient, 1);
}

#[test]
fn a_fixed_threshold_sees_nothing_in_dim_light() {
    let progress = drive("oval", FIXED, Lighting::DimGradient, 1);
    assert_eq!(
        (progress.laps, progress.distance_m),
        (0, 0.0),
        "the follower never gets a steering angle: {progress:?}"
    );
}

#[test]
fn holds_random_tracks_by_camera() {
    for seed in 0..thorough::count(1, 6) {
        keeps_the_lane(&format!("random:{seed}"), FIXED, Lighting::Even, 1);
    }
}

#[test]
fn holds_every_track_by_the_ideal_lane() {
    keeps_the_lane("oval", Eye::IdealLane, Lighting::Even, 2);
    keeps_the_lane("s-bends", Eye::IdealLane, Lighting::Even, 2);
    for seed in 0..thorough::count(4, 20) {
        keeps_the_lane(&format!("random:{seed}"), Eye::IdealLane, Lighting::Even, 1);
    }
}
