//! A drive on a floor picture made by others (a SEAT Autonomous Driving Challenge circuit of 12 m x 12 m), when it is there.

use std::path::{Path, PathBuf};

use crate::rig::{Eye, Rig, Threshold, follow};
use crate::thorough;
use carril_simulator::SimWorldConfig;
use carril_simulator::config::CameraConfig;

/// The road from the bottom straight round the right-hand corner, up the right side and round the upper loop, along its dashed
/// middle line. The same text is in docs/simulator.md.
const TRACK: &str = "\
floor: { image: IMAGE, width_m: 12, height_m: 12, colour: [26, 26, 26] }
lane:
  width_m: 0.845       # the whole road: two lanes with a dashed line between them
  centre:
    points: [
        [2.50, 0.92], [3.50, 0.92], [4.50, 0.92], [5.50, 0.92], [6.50, 0.92], [7.50, 0.92], [8.50, 0.92],
        [9.50, 0.92], [9.71, 0.92], [10.24, 1.03], [10.68, 1.32], [10.97, 1.76], [11.08, 2.29], [11.08, 3.21],
        [11.08, 4.14], [11.08, 5.07], [11.08, 6.00], [11.08, 6.93], [11.08, 7.86], [11.08, 8.79], [11.07, 9.71],
        [10.98, 10.21], [10.71, 10.64], [10.30, 10.94], [9.81, 11.07], [9.31, 11.02], [8.86, 10.78], [8.53, 10.40],
        [6.50, 7.00], [3.00, 4.00], [1.60, 1.80]   # back across the bare floor, so that the line closes; nobody drives there
      ]
";

fn picture() -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/seat/full.png");
    let there = path.exists();
    if !there {
        println!("skipped: `{}` is not there", path.display());
    }
    there.then_some(path)
}

#[test]
fn follows_a_road_on_a_picture_of_fifty_million_pixels() {
    let Some(picture) = picture() else { return };
    // Two straights, a corner and a loop take 19.8 m; the first straight alone is 7 m.
    let (limit_s, distance_m) = thorough::count((12.0, 5.0), (40.0, 19.0));
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("seat.yaml");
    std::fs::write(&file, TRACK.replace("IMAGE", &picture.display().to_string())).expect("written");
    // The road is twice as wide as a lane: a higher and wider camera sees both of its edges, with the dashed line between them.
    let camera = CameraConfig {
        height_m: 0.45,
        pitch_deg: 20.0,
        horizontal_fov_deg: 120.0,
        floor_texel_mm: 5.0,
        ..CameraConfig::default()
    };
    let mut config = SimWorldConfig { track: file.display().to_string(), camera, ..SimWorldConfig::default() };
    config.start.along_m = 0.5;
    let mut rig = Rig::new(config, 1, true);
    let progress = follow(&mut rig, Eye::Camera { threshold: Threshold::Fixed(190) }, 0.5, 1, limit_s);
    println!("{progress:?}");
    assert!(progress.distance_m > distance_m, "{} m in {limit_s} s, expected {distance_m}", progress.distance_m);
    assert_eq!(progress.departures, 0, "wheels beyond the road: {progress:?}");
    assert!(progress.cross_track_rms_m <= 0.05, "rms {} m", progress.cross_track_rms_m);
}
