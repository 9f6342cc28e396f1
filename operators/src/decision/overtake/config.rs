//! How the car overtakes.

use carril_runtime::Findings;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the car overtakes what stands or crawls in its lane. It needs the lane on the floor (`lane-lines`), `scan` and `wheels`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct OvertakeConfig {
    /// Overtake. Otherwise the car stops behind what is in its way.
    pub enabled: bool,
    /// It pulls out when it is this near to what is ahead, from its front, m, 0.3 to 5.
    #[schemars(range(min = 0.3, max = 5), extend("unit" = "m"))]
    pub begin_m: f64,
    /// While it cannot overtake it stays this far behind, from its front, m, 0.1 to 5.
    #[schemars(range(min = 0.1, max = 5), extend("unit" = "m"))]
    pub wait_m: f64,
    /// It overtakes what drives at no more than this share of its own speed, 0 to 0.95.
    #[schemars(range(min = 0, max = 0.95), extend("unit" = "share"))]
    pub slower_share: f64,
    /// The way that it plans stays this far away from everything, m, 0 to 1.
    #[schemars(range(min = 0, max = 1), extend("unit" = "m"))]
    pub clearance_m: f64,
    /// The left lane must be free so far ahead of its front, m, 0 to 20, ...
    #[schemars(range(min = 0, max = 20), extend("unit" = "m"))]
    pub free_ahead_m: f64,
    /// ... and so far behind its rear axle, m, 0 to 5.
    #[schemars(range(min = 0, max = 5), extend("unit" = "m"))]
    pub free_behind_m: f64,
    /// A change of lanes takes at least this way, m, 0.3 to 10, ...
    #[schemars(range(min = 0.3, max = 10), extend("unit" = "m"))]
    pub change_min_m: f64,
    /// ... and at most this, m, `change_min_m` to 20. The longest that leads past what is ahead is taken.
    #[schemars(range(min = 0.3, max = 20), extend("unit" = "m"))]
    pub change_max_m: f64,
    /// It gives up, and stands, after so much way beside its lane, m, 1 to 200.
    #[schemars(range(min = 1, max = 200), extend("unit" = "m"))]
    pub pass_max_m: f64,
    /// Speed meanwhile, at most, m/s, > 0 to 20.
    #[schemars(range(max = 20), extend("exclusiveMinimum" = 0, "unit" = "m/s"))]
    pub speed_m_s: f64,
    /// Returns of the lidar that are something; fewer are noise. 1 to 100.
    #[schemars(range(min = 1, max = 100), extend("unit" = "returns"))]
    pub min_returns: u32,
}

impl Default for OvertakeConfig {
    fn default() -> Self {
        Self {
            enabled: false,
            begin_m: 1.2,
            wait_m: 0.8,
            slower_share: 0.7,
            clearance_m: 0.06,
            free_ahead_m: 2.0,
            free_behind_m: 0.5,
            change_min_m: 1.1,
            change_max_m: 2.2,
            pass_max_m: 12.0,
            speed_m_s: 0.5,
            min_returns: 3,
        }
    }
}

impl OvertakeConfig {
    pub(in crate::decision) fn check(&self, findings: &mut Findings<'_>) {
        for (name, value, min, max, unit) in [
            ("begin_m", self.begin_m, 0.3, 5.0, "m"),
            ("wait_m", self.wait_m, 0.1, 5.0, "m"),
            ("slower_share", self.slower_share, 0.0, 0.95, ""),
            ("clearance_m", self.clearance_m, 0.0, 1.0, "m"),
            ("free_ahead_m", self.free_ahead_m, 0.0, 20.0, "m"),
            ("free_behind_m", self.free_behind_m, 0.0, 5.0, "m"),
            ("change_min_m", self.change_min_m, 0.3, 10.0, "m"),
            ("pass_max_m", self.pass_max_m, 1.0, 200.0, "m"),
        ] {
            findings.range(&format!("overtake.{name}"), value, min, max, unit);
        }
        findings.require(
            self.change_max_m >= self.change_min_m && self.change_max_m <= 20.0,
            "overtake.change_max_m",
            || {
                let (got, least) = (self.change_max_m, self.change_min_m);
                format!("got {got} m, allowed is `overtake.change_min_m` ({least} m) to 20 m")
            },
        );
        findings.require(self.speed_m_s > 0.0 && self.speed_m_s <= 20.0, "overtake.speed_m_s", || {
            format!("got {}, allowed is more than 0, up to 20 m/s", self.speed_m_s)
        });
        findings.range("overtake.min_returns", f64::from(self.min_returns), 1.0, 100.0, "returns");
    }
}
