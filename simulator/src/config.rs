//! The configuration of `sim-world`: which track, and how car and sensors are built. Everything has a default.

use carril_messages::car::{BATTERY_FULL_V, LIDAR_FORWARD_M};
use carril_runtime::{Findings, OperatorConfig};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::camera::light::Lighting;
use crate::camera::model::CameraModel;
use crate::obstacles::{Obstacles, Placed};
use crate::track::Track;
use crate::world::start_pose;

/// No world has more obstacles besides those of its track.
const MOST_OBSTACLES: usize = 64;

/// Which world, and how the car in it is built.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimWorldConfig {
    /// `oval`, `s-bends`, `random:SEED`, or a track file, relative to the folder of the graph file.
    pub track: String,
    /// Of all noise. The seed of the run is mixed in.
    #[schemars(extend("unit" = ""))]
    pub seed: u64,
    /// Where the car starts, against the track's own start.
    pub start: StartConfig,
    /// The camera.
    pub camera: CameraConfig,
    /// The lidar.
    pub lidar: LidarConfig,
    /// The car.
    pub vehicle: VehicleConfig,
    /// Boxes on the lane or beside it, besides those of the track, at most 64. One with a speed crawls along the lane, and waits for a
    /// car in its way.
    #[schemars(length(max = 64))]
    pub obstacles: Vec<ObstacleConfig>,
    /// When the e-stop button is pressed: spans of time from the start, s, like `[[10, 12]]`.
    #[schemars(inner(inner(range(min = 0))), extend("unit" = "s"))]
    pub estop_pressed_s: Vec<[f64; 2]>,
}

/// A start away from the track's own.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StartConfig {
    /// Farther along the lane, m.
    #[schemars(range(min = 0, max = 500), extend("unit" = "m"))]
    pub along_m: f64,
    /// To the left, m.
    #[schemars(range(min = -5, max = 5), extend("unit" = "m"))]
    pub left_m: f64,
    /// Turned to the left, degrees.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub yaw_deg: f64,
}

/// A grey box on the lane or beside it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ObstacleConfig {
    /// Its middle, along the lane from the start of the track, m. Without a lane: straight ahead from there.
    #[schemars(range(min = -500, max = 500), extend("unit" = "m"))]
    pub along_m: f64,
    /// Its middle, to the left of the lane's middle, m.
    #[schemars(range(min = -5, max = 5), extend("unit" = "m"))]
    pub left_m: f64,
    /// Turned to the left against the lane, degrees.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub yaw_deg: f64,
    /// Along itself, m.
    #[schemars(range(min = 0.01, max = 2), extend("unit" = "m"))]
    pub length_m: f64,
    /// Across, m.
    #[schemars(range(min = 0.01, max = 2), extend("unit" = "m"))]
    pub width_m: f64,
    /// m. The lidar sees what is as high as it.
    #[schemars(range(min = 0.01, max = 5), extend("unit" = "m"))]
    pub height_m: f64,
    /// Along the lane, m/s. Below 0: it comes towards the car. 0: it stands.
    #[schemars(range(min = -5, max = 5), extend("unit" = "m/s"))]
    pub speed_m_s: f64,
}

/// The camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CameraConfig {
    /// Pixels in a row.
    #[schemars(range(min = 16, max = 4096), extend("unit" = "px"))]
    pub width: usize,
    /// Rows.
    #[schemars(range(min = 16, max = 4096), extend("unit" = "px"))]
    pub height: usize,
    /// Frames per second.
    #[schemars(range(min = 0.1, max = 200), extend("unit" = "Hz"))]
    pub rate_hz: f64,
    /// Above the floor, m.
    #[schemars(range(min = 0.02, max = 2), extend("unit" = "m"))]
    pub height_m: f64,
    /// Ahead of the rear axle, m.
    #[schemars(range(min = -1, max = 1), extend("unit" = "m"))]
    pub forward_m: f64,
    /// Looking down, degrees.
    #[schemars(range(min = 0, max = 80), extend("unit" = "degrees"))]
    pub pitch_deg: f64,
    /// From the left edge to the right edge of the image, degrees.
    #[schemars(range(min = 10, max = 150), extend("unit" = "degrees"))]
    pub horizontal_fov_deg: f64,
    /// How the scene is lit.
    pub lighting: Lighting,
    /// Factor on all brightness.
    #[schemars(range(min = 0.05, max = 8), extend("unit" = ""))]
    pub exposure: f64,
    /// Standard deviation of the noise, grey levels; 0 is none.
    #[schemars(range(min = 0, max = 50), extend("unit" = "grey levels"))]
    pub noise_grey: f64,
    /// Half side of the square that a pixel averages over, px; 0 is sharp.
    #[schemars(range(min = 0, max = 20), extend("unit" = "px"))]
    pub blur_px: usize,
    /// Resolution at which the floor is drawn, mm. Small is sharp and takes memory.
    #[schemars(range(min = 0.5, max = 50), extend("unit" = "mm"))]
    pub floor_texel_mm: f64,
}

/// The lidar.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LidarConfig {
    /// Scans per second.
    #[schemars(range(min = 0.1, max = 50), extend("unit" = "Hz"))]
    pub rate_hz: f64,
    /// Points of a scan.
    #[schemars(range(min = 8, max = 4096), extend("unit" = "points"))]
    pub points: usize,
    /// Nearest range, m. Nearer returns are `-inf`.
    #[schemars(range(min = 0, max = 1), extend("unit" = "m"))]
    pub range_min_m: f64,
    /// Farthest range, m. Farther returns are `+inf`.
    #[schemars(range(min = 1, max = 100), extend("unit" = "m"))]
    pub range_max_m: f64,
    /// Standard deviation of a range, m.
    #[schemars(range(min = 0, max = 1), extend("unit" = "m"))]
    pub noise_m: f64,
    /// Share of points that see nothing although something is there (`+inf`), 0 to 1.
    #[schemars(range(min = 0, max = 1), extend("unit" = "share"))]
    pub dropout: f64,
    /// Ahead of the rear axle, m.
    #[schemars(range(min = -1, max = 1), extend("unit" = "m"))]
    pub forward_m: f64,
    /// To the left of the middle, m.
    #[schemars(range(min = -1, max = 1), extend("unit" = "m"))]
    pub left_m: f64,
    /// Of the scanning plane above the floor, m. Lower things are not seen.
    #[schemars(range(min = 0, max = 2), extend("unit" = "m"))]
    pub height_m: f64,
    /// Direction of the sensor's x axis, body frame, degrees, + left.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub mounting_deg: f64,
    /// Parts of the car in view.
    pub posts: Vec<Post>,
}

/// A part of the car in the lidar's view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Post {
    /// Its middle, body frame, degrees, + left.
    #[schemars(range(min = -360, max = 360), extend("unit" = "degrees"))]
    pub bearing_deg: f64,
    /// Angle that it covers, degrees.
    #[schemars(range(min = 0, max = 180), extend("unit" = "degrees"))]
    pub width_deg: f64,
    /// From the lidar, m.
    #[schemars(range(min = 0, max = 2), extend("unit" = "m"))]
    pub range_m: f64,
}

/// The car. Wheelbase, width, servo stops and encoder are those of the 1:10 car.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct VehicleConfig {
    /// Time constant of the servo, ms.
    #[schemars(range(min = 0, max = 10000), extend("unit" = "ms"))]
    pub servo_lag_ms: f64,
    /// Fastest turn of the road wheels, degrees/s.
    #[schemars(range(min = 1, max = 10000), extend("unit" = "degrees/s"))]
    pub servo_rate_deg_s: f64,
    /// Time constant of the driven motor, ms.
    #[schemars(range(min = 0, max = 10000), extend("unit" = "ms"))]
    pub motor_lag_ms: f64,
    /// Time constant of the braking motor, ms.
    #[schemars(range(min = 0, max = 10000), extend("unit" = "ms"))]
    pub brake_lag_ms: f64,
    /// Time constant of the free motor, ms.
    #[schemars(range(min = 0, max = 10000), extend("unit" = "ms"))]
    pub coast_lag_ms: f64,
    /// The wheels stand at this angle when told 0, degrees, + left.
    #[schemars(range(min = -20, max = 20), extend("unit" = "degrees"))]
    pub steering_offset_deg: f64,
    /// The wheels turn by this factor of what they are told.
    #[schemars(range(min = 0.1, max = 2), extend("unit" = ""))]
    pub steering_gain: f64,
    /// Lengthens the wheelbase by this much per (m/s)², s²/m; 0: no understeer.
    #[schemars(range(min = 0, max = 1), extend("unit" = "s²/m"))]
    pub understeer_s2_m: f64,
    /// Share of the wheels' way that is lost to slip, 0 to 1.
    #[schemars(range(min = 0, max = 0.9), extend("unit" = "share"))]
    pub wheel_slip: f64,
    /// Battery at rest, V.
    #[schemars(range(min = 5, max = BATTERY_FULL_V), extend("unit" = "V"))]
    pub battery_v: f64,
    /// Less at full load, V.
    #[schemars(range(min = 0, max = 3), extend("unit" = "V"))]
    pub battery_sag_v: f64,
}

impl Default for SimWorldConfig {
    fn default() -> Self {
        Self {
            track: "oval".into(),
            seed: 1,
            start: StartConfig::default(),
            camera: CameraConfig::default(),
            lidar: LidarConfig::default(),
            vehicle: VehicleConfig::default(),
            obstacles: Vec::new(),
            estop_pressed_s: Vec::new(),
        }
    }
}

impl Default for ObstacleConfig {
    /// About as large as the car, and stands 2 m ahead of the start.
    fn default() -> Self {
        Self { along_m: 2.0, left_m: 0.0, yaw_deg: 0.0, length_m: 0.35, width_m: 0.2, height_m: 0.2, speed_m_s: 0.0 }
    }
}

impl Default for CameraConfig {
    /// A wide-angle camera on a mast. Chosen so that the lane follower's gains (0.9 and 0.005 rad/px, rows 75 % and 85 %) keep the
    /// middle of curves down to 1 m radius: docs/simulator.md has the calculation.
    fn default() -> Self {
        Self {
            width: 640,
            height: 480,
            rate_hz: 30.0,
            height_m: 0.30,
            forward_m: 0.10,
            pitch_deg: 22.0,
            horizontal_fov_deg: 110.0,
            lighting: Lighting::Even,
            exposure: 1.0,
            noise_grey: 2.0,
            blur_px: 0,
            floor_texel_mm: 2.5,
        }
    }
}

impl Default for LidarConfig {
    /// A lidar in front of the camera's mast, whose two posts stand behind it.
    fn default() -> Self {
        let post = |bearing_deg| Post { bearing_deg, width_deg: 8.0, range_m: 0.09 };
        Self {
            rate_hz: 10.0,
            points: 360,
            range_min_m: 0.05,
            range_max_m: 16.0,
            noise_m: 0.01,
            dropout: 0.01,
            forward_m: LIDAR_FORWARD_M,
            left_m: 0.0,
            height_m: 0.12,
            mounting_deg: 0.0,
            posts: vec![post(150.0), post(-150.0)],
        }
    }
}

impl Default for VehicleConfig {
    fn default() -> Self {
        Self {
            servo_lag_ms: 40.0,
            // A servo of 0.16 s per 60 degrees, geared down to the wheels by 75 to 40 degrees.
            servo_rate_deg_s: 200.0,
            motor_lag_ms: 200.0,
            brake_lag_ms: 60.0,
            coast_lag_ms: 800.0,
            steering_offset_deg: 0.0,
            steering_gain: 1.0,
            understeer_s2_m: 0.0,
            wheel_slip: 0.0,
            battery_v: 8.2,
            battery_sag_v: 0.5,
        }
    }
}

impl CameraConfig {
    /// The camera's geometry.
    pub fn model(&self) -> CameraModel {
        let (fov_rad, pitch_rad) = (self.horizontal_fov_deg.to_radians(), self.pitch_deg.to_radians());
        CameraModel::new(self.width, self.height, fov_rad, pitch_rad, self.height_m, self.forward_m)
    }

    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("camera.width", self.width as f64, 16.0, 4096.0, "px");
        findings.range("camera.height", self.height as f64, 16.0, 4096.0, "px");
        findings.range("camera.rate_hz", self.rate_hz, 0.1, 200.0, "Hz");
        findings.range("camera.height_m", self.height_m, 0.02, 2.0, "m");
        findings.range("camera.forward_m", self.forward_m, -1.0, 1.0, "m");
        findings.range("camera.pitch_deg", self.pitch_deg, 0.0, 80.0, "degrees");
        findings.range("camera.horizontal_fov_deg", self.horizontal_fov_deg, 10.0, 150.0, "degrees");
        findings.range("camera.exposure", self.exposure, 0.05, 8.0, "");
        findings.range("camera.noise_grey", self.noise_grey, 0.0, 50.0, "grey levels");
        findings.range("camera.blur_px", self.blur_px as f64, 0.0, 20.0, "px");
        findings.range("camera.floor_texel_mm", self.floor_texel_mm, 0.5, 50.0, "mm");
    }
}

impl LidarConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("lidar.rate_hz", self.rate_hz, 0.1, 50.0, "Hz");
        findings.range("lidar.points", self.points as f64, 8.0, 4096.0, "");
        findings.range("lidar.range_min_m", self.range_min_m, 0.0, 1.0, "m");
        findings.range("lidar.range_max_m", self.range_max_m, 1.0, 100.0, "m");
        findings.range("lidar.noise_m", self.noise_m, 0.0, 1.0, "m");
        findings.range("lidar.dropout", self.dropout, 0.0, 1.0, "");
        findings.range("lidar.forward_m", self.forward_m, -1.0, 1.0, "m");
        findings.range("lidar.left_m", self.left_m, -1.0, 1.0, "m");
        findings.range("lidar.height_m", self.height_m, 0.0, 2.0, "m");
        findings.range("lidar.mounting_deg", self.mounting_deg, -360.0, 360.0, "degrees");
        for (index, post) in self.posts.iter().enumerate() {
            let field = |name: &str| format!("lidar.posts.{index}.{name}");
            findings.range(&field("bearing_deg"), post.bearing_deg, -360.0, 360.0, "degrees");
            findings.range(&field("width_deg"), post.width_deg, 0.0, 180.0, "degrees");
            findings.range(&field("range_m"), post.range_m, 0.0, 2.0, "m");
        }
    }
}

impl VehicleConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        for (field, lag_ms) in [
            ("vehicle.servo_lag_ms", self.servo_lag_ms),
            ("vehicle.motor_lag_ms", self.motor_lag_ms),
            ("vehicle.brake_lag_ms", self.brake_lag_ms),
            ("vehicle.coast_lag_ms", self.coast_lag_ms),
        ] {
            findings.range(field, lag_ms, 0.0, 10_000.0, "ms");
        }
        findings.range("vehicle.servo_rate_deg_s", self.servo_rate_deg_s, 1.0, 10_000.0, "degrees/s");
        findings.range("vehicle.steering_offset_deg", self.steering_offset_deg, -20.0, 20.0, "degrees");
        findings.range("vehicle.steering_gain", self.steering_gain, 0.1, 2.0, "");
        findings.range("vehicle.understeer_s2_m", self.understeer_s2_m, 0.0, 1.0, "s²/m");
        findings.range("vehicle.wheel_slip", self.wheel_slip, 0.0, 0.9, "");
        findings.range("vehicle.battery_v", self.battery_v, 5.0, BATTERY_FULL_V, "V");
        findings.range("vehicle.battery_sag_v", self.battery_sag_v, 0.0, 3.0, "V");
    }
}

impl ObstacleConfig {
    fn check(&self, path: &str, findings: &mut Findings<'_>) {
        for (name, value, min, max, unit) in [
            ("along_m", self.along_m, -500.0, 500.0, "m"),
            ("left_m", self.left_m, -5.0, 5.0, "m"),
            ("yaw_deg", self.yaw_deg, -360.0, 360.0, "degrees"),
            ("length_m", self.length_m, 0.01, 2.0, "m"),
            ("width_m", self.width_m, 0.01, 2.0, "m"),
            ("height_m", self.height_m, 0.01, 5.0, "m"),
            ("speed_m_s", self.speed_m_s, -5.0, 5.0, "m/s"),
        ] {
            findings.range(&format!("{path}.{name}"), value, min, max, unit);
        }
    }
}

impl OperatorConfig for SimWorldConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("start.along_m", self.start.along_m, 0.0, 500.0, "m");
        findings.range("start.left_m", self.start.left_m, -5.0, 5.0, "m");
        findings.range("start.yaw_deg", self.start.yaw_deg, -360.0, 360.0, "degrees");
        for (index, [from, to]) in self.estop_pressed_s.iter().enumerate() {
            findings.require(*from >= 0.0 && from < to, &format!("estop_pressed_s.{index}"), || {
                format!("got [{from}, {to}], expected [from, to] with 0 <= from < to")
            });
        }
        self.camera.check(findings);
        self.lidar.check(findings);
        self.vehicle.check(findings);
        findings.require(self.obstacles.len() <= MOST_OBSTACLES, "obstacles", || {
            format!("got {}, allowed are at most {MOST_OBSTACLES}", self.obstacles.len())
        });
        for (index, obstacle) in self.obstacles.iter().enumerate() {
            obstacle.check(&format!("obstacles.{index}"), findings);
        }
        self.check_track(findings);
    }
}

impl SimWorldConfig {
    fn check_track(&self, findings: &mut Findings<'_>) {
        match Track::load(&self.track, findings.base_dir()) {
            Ok(track) => {
                let mut obstacles = Obstacles::of(&track);
                let start = start_pose(&track, &self.start);
                let inside = |obstacles: &Obstacles| obstacles.touches(start);
                findings
                    .require(!inside(&obstacles), "track", || "the car would start inside a box or a wall".to_owned());
                obstacles = Obstacles::default();
                obstacles.place(&Placed::new(&self.obstacles, &track).blocks(&track, &[]));
                findings
                    .require(!inside(&obstacles), "obstacles", || "the car would start inside one of them".to_owned());
                for (index, obstacle) in self.obstacles.iter().enumerate() {
                    let can = obstacle.speed_m_s == 0.0 || track.lane.is_some();
                    findings.require(can, &format!("obstacles.{index}.speed_m_s"), || {
                        let speed_m_s = obstacle.speed_m_s;
                        format!("got {speed_m_s} m/s, but the track has no lane to crawl along; allowed is 0")
                    });
                }
                if Track::is_file(&self.track) {
                    findings.file("track", &self.track);
                }
            }
            Err(error) => {
                for (line, hint) in error.lines() {
                    findings.report("track", line, hint.map(str::to_owned));
                }
            }
        }
    }
}
