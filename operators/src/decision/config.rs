//! The configuration of the decision node: gains, speeds, and how long and how near is too long and too near.

use carril_messages::car;
use carril_runtime::{Findings, OperatorConfig};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::light::LightConfig;
use super::overtake::OvertakeConfig;
use super::park::ParkConfig;
use crate::scan_points::BodyConfig;

/// Configuration of the decision node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DecisionConfig {
    /// Drive without waiting for `start`. For simulations: on a real car nothing shall move before a person says so.
    pub auto_start: bool,
    /// Steering per angle of the lane, rad/rad, -10 to 10.
    #[schemars(range(min = -10, max = 10), extend("unit" = "rad/rad"))]
    pub k_angle: f64,
    /// Steering per distance of the lane, rad/px, -1 to 1.
    #[schemars(range(min = -1, max = 1), extend("unit" = "rad/px"))]
    pub k_distance_rad_per_px: f64,
    /// Where the lane's line shall lie, px, + left of the car, -10000 to 10000. 0: the car drives on the line.
    #[schemars(range(min = -10000, max = 10000), extend("unit" = "px"))]
    pub target_distance_px: f64,
    /// Where the detector gives the lane on the floor (`lane-lines`), the car steers towards a point of its middle this far from the
    /// rear axle, m, 0.05 to 10, ...
    #[schemars(range(min = 0.05, max = 10), extend("unit" = "m"))]
    pub lookahead_m: f64,
    /// ... and farther with the speed, m per m/s, 0 to 3.
    #[schemars(range(min = 0, max = 3), extend("unit" = "s"))]
    pub lookahead_s: f64,
    /// From a command to wheels that have turned, ms, 0 to 1000: the car steers from where it will be then. For a lane on the floor.
    #[schemars(range(min = 0, max = 1000), extend("unit" = "ms"))]
    pub steering_delay_ms: f64,
    /// From axle to axle, m, 0.05 to 5. For a lane on the floor.
    #[schemars(range(min = 0.05, max = 5), extend("unit" = "m"))]
    pub wheelbase_m: f64,
    /// Largest road-wheel angle to either side, degrees, > 0 to 60.
    #[schemars(range(max = 60), extend("exclusiveMinimum" = 0, "unit" = "degrees"))]
    pub max_steering_deg: f64,
    /// Speed on the lane, m/s, > 0 to `max_speed_m_s`. A goal may change it.
    #[schemars(range(max = 20), extend("exclusiveMinimum" = 0, "unit" = "m/s"))]
    pub cruise_speed_m_s: f64,
    /// A person who drives by hand drives no faster, in either direction, m/s, > 0 to 20.
    #[schemars(range(max = 20), extend("exclusiveMinimum" = 0, "unit" = "m/s"))]
    pub manual_max_speed_m_s: f64,
    /// The dead man's switch: an older command of a person who drives by hand stops the car, ms, 20 to 1000.
    #[schemars(range(min = 20, max = 1000), extend("unit" = "ms"))]
    pub manual_timeout_ms: f64,
    /// Speed while the lane is lost, for `coast_s`, m/s, 0 to `max_speed_m_s`.
    #[schemars(range(min = 0, max = 20), extend("unit" = "m/s"))]
    pub coast_speed_m_s: f64,
    /// No goal makes the car faster, m/s, > 0 to 20.
    #[schemars(range(max = 20), extend("exclusiveMinimum" = 0, "unit" = "m/s"))]
    pub max_speed_m_s: f64,
    /// Estimates of a lower quality are no lane, 0 to 1.
    #[schemars(range(min = 0, max = 1), extend("unit" = ""))]
    pub min_quality: f64,
    /// So many estimates in a row without a lane make it lost, 1 to 100. Until then the steering is held.
    #[schemars(range(min = 1, max = 100), extend("unit" = "frames"))]
    pub lane_lost_frames: u32,
    /// So many estimates in a row with a lane make it found, 1 to 100.
    #[schemars(range(min = 1, max = 100), extend("unit" = "frames"))]
    pub lane_ok_frames: u32,
    /// An older estimate counts as none, ms, 10 to 5000. Measured from the exposure.
    #[schemars(range(min = 10, max = 5000), extend("unit" = "ms"))]
    pub lane_timeout_ms: f64,
    /// How long the car coasts when it loses the lane, s, 0 to 10.
    #[schemars(range(min = 0, max = 10), extend("unit" = "s"))]
    pub coast_s: f64,
    /// The sector that must be free.
    pub front_sector: String,
    /// An obstacle this near stops the car, m, > 0 to 50.
    #[schemars(range(max = 50), extend("exclusiveMinimum" = 0, "unit" = "m"))]
    pub obstacle_stop_m: f64,
    /// An obstacle must be farther than this before the car goes on, m, `obstacle_stop_m` to 50.
    #[schemars(range(max = 50), extend("exclusiveMinimum" = 0, "unit" = "m"))]
    pub obstacle_clear_m: f64,
    /// For so long the way must be clear before the car goes on, s, 0 to 60.
    #[schemars(range(min = 0, max = 60), extend("unit" = "s"))]
    pub clear_s: f64,
    /// Drive only with a lidar. Otherwise its silence stops the car only once it has been heard.
    pub require_sectors: bool,
    /// Older sectors count as unknown, ms, 20 to 5000. Measured from the scan.
    #[schemars(range(min = 20, max = 5000), extend("unit" = "ms"))]
    pub sectors_timeout_ms: f64,
    /// A front sector of which a smaller share was measured counts as unknown, 0 to 1.
    #[schemars(range(min = 0, max = 1), extend("unit" = "share"))]
    pub min_coverage: f64,
    /// What it does at a traffic light, where a node finds one (`light`).
    pub light: LightConfig,
    /// The car's outline, and where its lidar sits: for overtaking and parking.
    pub body: BodyConfig,
    /// How it overtakes.
    pub overtake: OvertakeConfig,
    /// How it parks.
    pub park: ParkConfig,
}

impl Default for DecisionConfig {
    fn default() -> Self {
        Self {
            auto_start: false,
            k_angle: 0.9,
            k_distance_rad_per_px: 0.005,
            target_distance_px: 0.0,
            lookahead_m: 0.35,
            lookahead_s: 0.2,
            steering_delay_ms: 60.0,
            wheelbase_m: car::WHEELBASE_M,
            max_steering_deg: car::STEERING_LIMIT_RAD.to_degrees(),
            cruise_speed_m_s: 0.5,
            manual_max_speed_m_s: 0.45,
            manual_timeout_ms: 150.0,
            coast_speed_m_s: 0.25,
            max_speed_m_s: 1.0,
            min_quality: 0.1,
            lane_lost_frames: 2,
            lane_ok_frames: 3,
            lane_timeout_ms: 150.0,
            coast_s: 0.5,
            front_sector: "front".into(),
            obstacle_stop_m: 0.5,
            obstacle_clear_m: 0.7,
            clear_s: 1.0,
            require_sectors: false,
            sectors_timeout_ms: 500.0,
            min_coverage: 0.3,
            light: LightConfig::default(),
            body: BodyConfig::default(),
            overtake: OvertakeConfig::default(),
            park: ParkConfig::default(),
        }
    }
}

impl OperatorConfig for DecisionConfig {
    fn check(&self, findings: &mut Findings<'_>) {
        findings.range("k_angle", self.k_angle, -10.0, 10.0, "rad/rad");
        findings.range("k_distance_rad_per_px", self.k_distance_rad_per_px, -1.0, 1.0, "rad/px");
        findings.range("target_distance_px", self.target_distance_px, -10_000.0, 10_000.0, "px");
        findings.range("lookahead_m", self.lookahead_m, 0.05, 10.0, "m");
        findings.range("lookahead_s", self.lookahead_s, 0.0, 3.0, "s");
        findings.range("steering_delay_ms", self.steering_delay_ms, 0.0, 1000.0, "ms");
        findings.range("wheelbase_m", self.wheelbase_m, 0.05, 5.0, "m");
        above_zero(findings, "max_steering_deg", self.max_steering_deg, 60.0, "degrees");
        above_zero(findings, "max_speed_m_s", self.max_speed_m_s, 20.0, "m/s");
        above_zero(findings, "cruise_speed_m_s", self.cruise_speed_m_s, self.max_speed_m_s, "m/s (`max_speed_m_s`)");
        above_zero(findings, "manual_max_speed_m_s", self.manual_max_speed_m_s, 20.0, "m/s");
        findings.range("manual_timeout_ms", self.manual_timeout_ms, 20.0, 1000.0, "ms");
        findings.range("coast_speed_m_s", self.coast_speed_m_s, 0.0, self.max_speed_m_s, "m/s");
        findings.range("min_quality", self.min_quality, 0.0, 1.0, "");
        findings.range("lane_lost_frames", f64::from(self.lane_lost_frames), 1.0, 100.0, "frames");
        findings.range("lane_ok_frames", f64::from(self.lane_ok_frames), 1.0, 100.0, "frames");
        findings.range("lane_timeout_ms", self.lane_timeout_ms, 10.0, 5000.0, "ms");
        findings.range("coast_s", self.coast_s, 0.0, 10.0, "s");
        findings.require(!self.front_sector.is_empty(), "front_sector", || {
            "got an empty name, allowed is the name of a sector of `lidar-sectors`: `front`".into()
        });
        above_zero(findings, "obstacle_stop_m", self.obstacle_stop_m, 50.0, "m");
        findings.require(
            self.obstacle_clear_m >= self.obstacle_stop_m && self.obstacle_clear_m <= 50.0,
            "obstacle_clear_m",
            || {
                let (got, least) = (self.obstacle_clear_m, self.obstacle_stop_m);
                format!("got {got} m, allowed is `obstacle_stop_m` ({least} m) to 50 m")
            },
        );
        findings.range("clear_s", self.clear_s, 0.0, 60.0, "s");
        findings.range("sectors_timeout_ms", self.sectors_timeout_ms, 20.0, 5000.0, "ms");
        findings.range("min_coverage", self.min_coverage, 0.0, 1.0, "");
        self.light.check(findings);
        self.body.check_at("body", findings);
        self.overtake.check(findings);
        self.park.check(findings);
    }
}

fn above_zero(findings: &mut Findings<'_>, field: &str, value: f64, max: f64, unit: &str) {
    findings.require(value > 0.0 && value <= max, field, || {
        format!("got {value}, allowed is more than 0, up to {max} {unit}")
    });
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::decision::Decision;
    use crate::testing::{fields_found, problems};

    #[test]
    fn every_bound_is_checked() {
        for (config, field) in [
            (json!({"k_angle": 11}), "k_angle"),
            (json!({"k_distance_rad_per_px": -2}), "k_distance_rad_per_px"),
            (json!({"target_distance_px": 20000}), "target_distance_px"),
            (json!({"lookahead_m": 0}), "lookahead_m"),
            (json!({"lookahead_s": -1}), "lookahead_s"),
            (json!({"steering_delay_ms": 2000}), "steering_delay_ms"),
            (json!({"wheelbase_m": 0}), "wheelbase_m"),
            (json!({"max_steering_deg": 0}), "max_steering_deg"),
            (json!({"max_steering_deg": 61}), "max_steering_deg"),
            (json!({"max_speed_m_s": 21}), "max_speed_m_s"),
            (json!({"cruise_speed_m_s": 0}), "cruise_speed_m_s"),
            (json!({"cruise_speed_m_s": 1.1}), "cruise_speed_m_s"),
            (json!({"manual_max_speed_m_s": 0}), "manual_max_speed_m_s"),
            (json!({"manual_timeout_ms": 10}), "manual_timeout_ms"),
            (json!({"coast_speed_m_s": -0.1}), "coast_speed_m_s"),
            (json!({"coast_speed_m_s": 1.1}), "coast_speed_m_s"),
            (json!({"min_quality": 1.1}), "min_quality"),
            (json!({"lane_lost_frames": 0}), "lane_lost_frames"),
            (json!({"lane_ok_frames": 101}), "lane_ok_frames"),
            (json!({"lane_timeout_ms": 9}), "lane_timeout_ms"),
            (json!({"coast_s": 11}), "coast_s"),
            (json!({"front_sector": ""}), "front_sector"),
            (json!({"obstacle_stop_m": 0}), "obstacle_stop_m"),
            (json!({"obstacle_clear_m": 0.4}), "obstacle_clear_m"),
            (json!({"clear_s": -1}), "clear_s"),
            (json!({"sectors_timeout_ms": 19}), "sectors_timeout_ms"),
            (json!({"min_coverage": 1.1}), "min_coverage"),
            (json!({"light": {"stop_before_m": 0}}), "light.stop_before_m"),
            (json!({"light": {"front_m": -1}}), "light.front_m"),
            (json!({"light": {"brake_m_s2": 0}}), "light.brake_m_s2"),
            (json!({"light": {"approach_speed_m_s": -1}}), "light.approach_speed_m_s"),
            (json!({"light": {"timeout_ms": 1}}), "light.timeout_ms"),
            (json!({"light": {"gone_s": -1}}), "light.gone_s"),
            (json!({"body": {"front_m": -1}}), "body.front_m"),
            (json!({"body": {"rear_m": 1}}), "body.rear_m"),
            (json!({"body": {"width_m": 0}}), "body.width_m"),
            (json!({"body": {"lidar_forward_m": 9}}), "body.lidar_forward_m"),
            (json!({"body": {"lidar_left_m": 9}}), "body.lidar_left_m"),
            (json!({"body": {"lidar_mounting_deg": 400}}), "body.lidar_mounting_deg"),
            (json!({"overtake": {"begin_m": 0}}), "overtake.begin_m"),
            (json!({"overtake": {"wait_m": 0}}), "overtake.wait_m"),
            (json!({"overtake": {"slower_share": 1}}), "overtake.slower_share"),
            (json!({"overtake": {"clearance_m": -1}}), "overtake.clearance_m"),
            (json!({"overtake": {"free_ahead_m": -1}}), "overtake.free_ahead_m"),
            (json!({"overtake": {"free_behind_m": -1}}), "overtake.free_behind_m"),
            (json!({"overtake": {"change_min_m": 0}}), "overtake.change_min_m"),
            (json!({"overtake": {"change_max_m": 1}}), "overtake.change_max_m"),
            (json!({"overtake": {"pass_max_m": 0}}), "overtake.pass_max_m"),
            (json!({"overtake": {"speed_m_s": 0}}), "overtake.speed_m_s"),
            (json!({"overtake": {"min_returns": 0}}), "overtake.min_returns"),
            (json!({"park": {"search_speed_m_s": 0}}), "park.search_speed_m_s"),
            (json!({"park": {"search_m": 0}}), "park.search_m"),
            (json!({"park": {"within_m": 3}}), "park.within_m"),
            (json!({"park": {"speed_m_s": 2}}), "park.speed_m_s"),
            (json!({"park": {"creep_m_s": 0}}), "park.creep_m_s"),
            (json!({"park": {"margin_m": -0.01}}), "park.margin_m"),
            (json!({"park": {"max_moves": 0}}), "park.max_moves"),
            (json!({"park": {"reserve_deg": 11}}), "park.reserve_deg"),
            (json!({"park": {"max_corrections": 21}}), "park.max_corrections"),
            (json!({"park": {"tolerance_m": 0}}), "park.tolerance_m"),
            (json!({"park": {"tolerance_deg": 0}}), "park.tolerance_deg"),
            (json!({"park": {"accept_m": 0}}), "park.accept_m"),
            (json!({"park": {"accept_deg": 0}}), "park.accept_deg"),
            (json!({"park": {"settle_s": 6}}), "park.settle_s"),
            (json!({"park": {"settle_m": 0}}), "park.settle_m"),
            (json!({"park": {"stop_s": 3}}), "park.stop_s"),
            (json!({"park": {"scan_timeout_ms": 10}}), "park.scan_timeout_ms"),
            (json!({"park": {"wheels_timeout_ms": 10}}), "park.wheels_timeout_ms"),
            (json!({"park": {"max_s": 0}}), "park.max_s"),
            (json!({"park": {"timed": {"back_in_s": -1}}}), "park.timed.back_in_s"),
        ] {
            let found = problems::<Decision>(&config);
            assert!(found.len() == 1 && found[0].starts_with(&format!("{field}: got ")), "{config}: {found:?}");
        }
        assert_eq!(problems::<Decision>(&json!({})), Vec::<String>::new(), "the defaults pass");
    }

    #[test]
    fn nan_is_refused_everywhere() {
        let nan = f64::NAN;
        let config = DecisionConfig {
            k_angle: nan,
            k_distance_rad_per_px: nan,
            target_distance_px: nan,
            lookahead_m: nan,
            lookahead_s: nan,
            steering_delay_ms: nan,
            wheelbase_m: nan,
            max_steering_deg: nan,
            cruise_speed_m_s: nan,
            coast_speed_m_s: nan,
            max_speed_m_s: nan,
            min_quality: nan,
            lane_timeout_ms: nan,
            coast_s: nan,
            obstacle_stop_m: nan,
            obstacle_clear_m: nan,
            clear_s: nan,
            sectors_timeout_ms: nan,
            min_coverage: nan,
            light: LightConfig {
                stop_before_m: nan,
                front_m: nan,
                brake_m_s2: nan,
                approach_speed_m_s: nan,
                timeout_ms: nan,
                gone_s: nan,
            },
            body: BodyConfig {
                front_m: nan,
                rear_m: nan,
                width_m: nan,
                lidar_forward_m: nan,
                lidar_left_m: nan,
                lidar_mounting_deg: nan,
            },
            overtake: OvertakeConfig {
                begin_m: nan,
                wait_m: nan,
                slower_share: nan,
                clearance_m: nan,
                free_ahead_m: nan,
                free_behind_m: nan,
                change_min_m: nan,
                change_max_m: nan,
                pass_max_m: nan,
                speed_m_s: nan,
                ..OvertakeConfig::default()
            },
            ..DecisionConfig::default()
        };
        assert_eq!(fields_found(&config).len(), 41, "every number: {:?}", fields_found(&config));
    }
}
