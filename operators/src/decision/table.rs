//! The FSM as one table: from which states, under which condition, to which state. The first rule that holds wins; the reason
//! carries the numbers that decided. docs/operators.md shows the same table and its diagram: both are made from it by a test, which
//! fails when they drift.

use std::time::Duration;

use carril_messages::DriveState::{
    self, EStop, Idle, LaneFollow, LaneLost, LightStop, Manual, ObstacleStop, OvertakeIn, OvertakeOut, OvertakePass,
    OvertakeStop, OvertakeWait, ParkDrive, ParkSearch, ParkStop, Parked,
};
use carril_messages::Stamp;

use super::config::DecisionConfig;
use super::facts::{Front, LaneMemory};
use super::light::LightMemory;
use super::overtake::OvertakeMemory;
use super::park::ParkMemory;

/// All that the guards may look at.
pub struct Facts<'a> {
    /// The time.
    pub now: Stamp,
    /// The configuration.
    pub config: &'a DecisionConfig,
    /// A person (or `auto_start`) wants the car to drive.
    pub go: bool,
    /// A person said `estop` and not yet `reset`.
    pub estop: bool,
    /// Age of the newest command of a person who drives by hand, if there was one since the last word.
    pub hand: Option<Duration>,
    /// The lane.
    pub lane: &'a LaneMemory,
    /// The way ahead.
    pub front: &'a Front,
    /// Since when it has been clear without a break.
    pub clear_since: Option<Stamp>,
    /// The traffic light.
    pub light: &'a LightMemory,
    /// The road, and the manoeuvre.
    pub overtake: &'a OvertakeMemory,
    /// Speed on the lane, m/s.
    pub cruise_speed_m_s: f64,
    /// Parking.
    pub park: &'a ParkMemory,
}

/// One transition.
pub struct Rule {
    /// From these states.
    pub from: &'static [DriveState],
    /// To this one.
    pub to: DriveState,
    /// When, in words, for the documentation.
    pub when: &'static str,
    /// When, and the reason with its numbers.
    guard: fn(&Facts<'_>) -> Option<String>,
}

const MOVING: &[DriveState] = &[
    LaneFollow,
    ObstacleStop,
    LightStop,
    LaneLost,
    OvertakeWait,
    OvertakeOut,
    OvertakePass,
    OvertakeIn,
    OvertakeStop,
    ParkSearch,
    ParkDrive,
    ParkStop,
    Parked,
];
/// Out of its lane, and on its way.
const BESIDE: &[DriveState] = &[OvertakeOut, OvertakePass, OvertakeIn];

/// Every transition, the most important first.
pub const RULES: &[Rule] = &[
    Rule {
        from: &[
            Idle,
            LaneFollow,
            ObstacleStop,
            LightStop,
            LaneLost,
            OvertakeWait,
            OvertakeOut,
            OvertakePass,
            OvertakeIn,
            OvertakeStop,
            ParkSearch,
            ParkDrive,
            ParkStop,
            Parked,
            Manual,
        ],
        to: EStop,
        when: "`estop` was said",
        guard: |facts| facts.estop.then(|| "`estop` was said; it stays until `reset`".into()),
    },
    Rule {
        from: &[EStop],
        to: Idle,
        when: "`reset` was said",
        guard: |facts| (!facts.estop).then(|| "`reset` was said; `start` to drive".into()),
    },
    Rule {
        from: &[
            Idle,
            LaneFollow,
            ObstacleStop,
            LightStop,
            LaneLost,
            OvertakeWait,
            OvertakeOut,
            OvertakePass,
            OvertakeIn,
            OvertakeStop,
            ParkSearch,
            ParkDrive,
            ParkStop,
            Parked,
        ],
        to: Manual,
        when: "a person drives by hand: a command on `manual` younger than `manual_timeout_ms`",
        guard: |facts| facts.hand_holds().then(|| "a person drives by hand".into()),
    },
    Rule {
        from: &[Manual],
        to: Idle,
        when: "no command on `manual` for `manual_timeout_ms` (released, closed or cut off), or `stop` or `reset` was said",
        guard: |facts| facts.hand_gone(),
    },
    Rule {
        from: MOVING,
        to: Idle,
        when: "`stop` or `reset` was said",
        guard: |facts| (!facts.go).then(|| "`stop` was said; `start` to drive".into()),
    },
    Rule {
        from: BESIDE,
        to: OvertakeStop,
        when: "beside its lane: something is in the way, the scan, the wheels or the lane are silent, it takes longer than \
               `overtake.pass_max_m`, or the light is red",
        guard: |facts| facts.manoeuvre_hindered(),
    },
    Rule {
        from: &[Idle],
        to: OvertakeStop,
        when: "`start` was said (or `auto_start`) to a car that had left its lane to overtake",
        guard: |facts| (facts.go && facts.overtake.is_out()).then(|| "it stands beside its lane".into()),
    },
    Rule {
        from: &[Idle, LaneFollow, LightStop, LaneLost, OvertakeWait, ParkSearch],
        to: ObstacleStop,
        when: "driving is wanted and the front sector is blocked (nearest <= `obstacle_stop_m`) or unknown",
        guard: |facts| if facts.go { facts.hindered() } else { None },
    },
    Rule {
        from: &[LaneFollow, OvertakeWait, ParkSearch],
        to: LightStop,
        when: "the light is red and its stop line is not passed yet, or the node that was heard of it is silent for `light.timeout_ms`",
        guard: |facts| facts.light.stops(facts.now, &facts.config.light),
    },
    Rule {
        from: &[OvertakeStop],
        to: OvertakePass,
        when: "nothing has been in the way for `clear_s`",
        guard: |facts| facts.overtake.goes_on(facts.now, facts.config),
    },
    Rule {
        from: &[OvertakeOut],
        to: OvertakeIn,
        when: "the left lane is occupied, and it is not beside what it wanted to overtake yet",
        guard: |facts| facts.overtake.turns_back(facts.config),
    },
    Rule {
        from: &[OvertakeOut],
        to: OvertakePass,
        when: "the change of lanes is done",
        guard: |facts| facts.overtake.is_beside(),
    },
    Rule {
        from: &[OvertakePass],
        to: OvertakeIn,
        when: "nothing beside it and nothing ahead in its own lane, for the way that it takes to go in",
        guard: |facts| facts.overtake.has_passed(),
    },
    Rule {
        from: &[OvertakeIn],
        to: LaneFollow,
        when: "it is back in its lane",
        guard: |facts| facts.overtake.is_back(),
    },
    Rule {
        from: &[LaneFollow, OvertakeWait],
        to: OvertakeOut,
        when: "overtaking is enabled, something slower is within `overtake.begin_m` ahead in its lane, the left lane is free, and a way \
               past it was found",
        guard: |facts| facts.overtake.pulls_out(facts.cruise_speed_m_s, facts.config),
    },
    Rule {
        from: &[LaneFollow],
        to: OvertakeWait,
        when: "overtaking is enabled, and what is ahead cannot be overtaken yet",
        guard: |facts| facts.overtake.waits_because(facts.cruise_speed_m_s, facts.config),
    },
    Rule {
        from: &[OvertakeWait],
        to: LaneFollow,
        when: "nothing is ahead in its lane any more",
        guard: |facts| facts.overtake.is_alone(facts.config),
    },
    Rule {
        from: &[OvertakeWait],
        to: LaneLost,
        when: "no lane in `lane_lost_frames` in a row, or none younger than `lane_timeout_ms`",
        guard: |facts| facts.lane_gone(),
    },
    Rule {
        from: &[LightStop],
        to: LaneLost,
        when: "no lane in `lane_lost_frames` in a row, or none younger than `lane_timeout_ms`",
        guard: |facts| facts.lane_gone(),
    },
    Rule {
        from: &[LightStop],
        to: LaneFollow,
        when: "the light is green, or no light has been in view for `light.gone_s`",
        guard: |facts| facts.light.lets_go(facts.now, &facts.config.light),
    },
    Rule {
        from: &[Idle],
        to: LaneFollow,
        when: "`start` was said (or `auto_start`) and the lane was seen in `lane_ok_frames` in a row",
        guard: |facts| if facts.go { facts.lane_found() } else { None },
    },
    Rule {
        from: &[Idle],
        to: LaneLost,
        when: "`start` was said (or `auto_start`) and there is no lane yet",
        guard: |facts| facts.go.then(|| "driving is wanted; waits for a lane".into()),
    },
    Rule {
        from: &[LaneFollow, ParkSearch],
        to: LaneLost,
        when: "no lane in `lane_lost_frames` in a row, or none younger than `lane_timeout_ms`",
        guard: |facts| facts.lane_gone(),
    },
    Rule {
        from: &[LaneFollow],
        to: ParkSearch,
        when: "the goal is to park",
        guard: |facts| facts.park.wanted(&facts.config.park),
    },
    Rule {
        from: &[ParkSearch],
        to: LaneFollow,
        when: "the goal is not to park any more",
        guard: |facts| facts.park.withdrawn(),
    },
    Rule {
        from: &[ParkSearch],
        to: ParkDrive,
        when: "a gap is long enough for `park.max_moves`",
        guard: |facts| facts.park.found(),
    },
    Rule {
        from: &[ParkSearch, ParkDrive],
        to: ParkStop,
        when: "no scan for `park.scan_timeout_ms`, no odometry for `park.wheels_timeout_ms`, no gap in `park.search_m`, the gap closes, \
               no move leads nearer to the place, or `park.max_s` are over",
        guard: |facts| facts.park.failed(),
    },
    Rule {
        from: &[ParkDrive],
        to: Parked,
        when: "the car stands in the gap within `park.tolerance_m` and `park.tolerance_deg`, or nothing brings it nearer",
        guard: |facts| facts.park.parked(),
    },
    Rule {
        from: &[ObstacleStop],
        to: LaneFollow,
        when: "front clear (nothing up to `obstacle_clear_m`) for `clear_s`, lane seen in `lane_ok_frames` in a row",
        guard: |facts| Some(format!("{}, {}", facts.clear_long_enough()?, facts.lane_found()?)),
    },
    Rule {
        from: &[ObstacleStop],
        to: LaneLost,
        when: "front clear for `clear_s`, no lane",
        guard: |facts| Some(format!("{}; waits for a lane", facts.clear_long_enough()?)),
    },
    Rule {
        from: &[LaneLost],
        to: LaneFollow,
        when: "lane seen in `lane_ok_frames` in a row",
        guard: |facts| facts.lane_found(),
    },
];

/// The transition that is due in `state`, and its reason.
pub fn due(state: DriveState, facts: &Facts<'_>) -> Option<(DriveState, String)> {
    let rules = RULES.iter().filter(|rule| rule.from.contains(&state));
    rules.into_iter().find_map(|rule| Some((rule.to, (rule.guard)(facts)?)))
}

impl Facts<'_> {
    fn hand_holds(&self) -> bool {
        self.hand.is_some_and(|age| age <= Duration::from_secs_f64(self.config.manual_timeout_ms * 1e-3))
    }

    fn hand_gone(&self) -> Option<String> {
        let limit_ms = self.config.manual_timeout_ms;
        match self.hand {
            _ if self.hand_holds() => None,
            Some(age) => {
                let age_ms = age.as_secs_f64() * 1e3;
                Some(format!(
                    "the driver's last command is {age_ms:.0} ms old, allowed are {limit_ms:.0} ms; `start` to drive"
                ))
            }
            None => Some("the driver let go, or `stop` was said; `start` to drive".into()),
        }
    }

    /// Whether the newest estimate is too old; its age.
    fn lane_silent(&self) -> Option<Duration> {
        let age = self.lane.age(self.now)?;
        (age > Duration::from_secs_f64(self.config.lane_timeout_ms * 1e-3)).then_some(age)
    }

    fn lane_found(&self) -> Option<String> {
        let found = self.lane.good >= self.config.lane_ok_frames && self.lane_silent().is_none();
        found.then(|| format!("lane seen in {} frames in a row", self.lane.good))
    }

    fn lane_gone(&self) -> Option<String> {
        if self.lane.captured.is_none() {
            return Some("no lane estimate has come yet".into());
        }
        if let Some(age) = self.lane_silent() {
            let (age_ms, limit_ms) = (age.as_secs_f64() * 1e3, self.config.lane_timeout_ms);
            return Some(format!("the newest lane estimate is {age_ms:.0} ms old, allowed are {limit_ms:.0} ms"));
        }
        let problem = self.lane.problem.filter(|_| self.lane.bad >= self.config.lane_lost_frames)?;
        Some(format!("{problem} for {} frames in a row", self.lane.bad))
    }

    fn hindered(&self) -> Option<String> {
        match self.front {
            Front::Blocked(nearest, returns) => {
                let limit = self.config.obstacle_stop_m;
                Some(format!("obstacle ahead at {nearest:.2} m ({returns} returns), stops at {limit:.2} m"))
            }
            Front::Unknown(why) => Some(format!("nothing is known of the way ahead: {why}")),
            Front::Clear(_) | Front::Near(_) | Front::NoLidar => None,
        }
    }

    fn manoeuvre_hindered(&self) -> Option<String> {
        let hindered = self.overtake.hindered(self.now, self.config);
        hindered.or_else(|| self.light.stops(self.now, &self.config.light))
    }

    fn clear_long_enough(&self) -> Option<String> {
        let clear_for = self.now.since(self.clear_since?).as_secs_f64();
        (clear_for >= self.config.clear_s).then(|| match self.front {
            Front::Clear(Some(nearest)) => format!("front clear for {clear_for:.1} s (nearest {nearest:.2} m)"),
            _ => format!("front clear for {clear_for:.1} s (nothing in reach)"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_state_can_be_entered_and_left_and_none_leads_to_itself() {
        for state in MOVING.iter().copied().chain([Idle, EStop, Manual]) {
            assert!(RULES.iter().any(|rule| rule.to == state), "{} can be entered", state.name());
            assert!(RULES.iter().any(|rule| rule.from.contains(&state)), "{} can be left", state.name());
        }
        assert!(RULES.iter().all(|rule| !rule.from.contains(&rule.to)), "no rule leads to where it starts");
    }

    #[test]
    fn the_only_way_out_of_the_estop_is_reset() {
        let ways: Vec<_> = RULES.iter().filter(|rule| rule.from.contains(&EStop)).map(|rule| rule.when).collect();
        assert_eq!(ways, ["`reset` was said"], "one rule");
    }

    const FROM: &str = "<!-- made from operators/src/decision/table.rs -->\n";
    const TO: &str = "<!-- end of what is made -->\n";

    /// The diagram and the table, as the documentation shows them.
    fn documentation() -> String {
        let id = |state: &DriveState| state.name().replace('-', "_");
        let mut states: Vec<DriveState> = RULES.iter().flat_map(|rule| rule.from).copied().collect();
        states.sort_by_key(|state| state.name());
        states.dedup();
        let mut lines = vec!["```mermaid".to_owned(), "stateDiagram-v2".to_owned()];
        lines.extend(states.iter().map(|state| format!("    state \"{}\" as {}", state.name(), id(state))));
        lines.push(format!("    [*] --> {}", id(&DriveState::default())));
        lines.extend(
            arrows()
                .iter()
                .map(|((from, to), numbers)| format!("    {} --> {}: {}", id(from), id(to), numbers.join(", "))),
        );
        lines.extend(["```", "", "| # | from | to | when |", "|---|---|---|---|"].map(str::to_owned));
        lines.extend(RULES.iter().enumerate().map(|(index, rule)| {
            let from: Vec<_> = rule.from.iter().map(|state| state.name()).collect();
            format!("| {} | {} | {} | {} |", index + 1, from.join(", "), rule.to.name(), rule.when)
        }));
        lines.join("\n") + "\n"
    }

    /// From where to where, and the numbers of all rules that lead along it.
    fn arrows() -> Vec<((DriveState, DriveState), Vec<String>)> {
        let mut arrows: Vec<((DriveState, DriveState), Vec<String>)> = Vec::new();
        for (index, rule) in RULES.iter().enumerate() {
            for from in rule.from {
                let (way, number) = ((*from, rule.to), (index + 1).to_string());
                match arrows.iter_mut().find(|arrow| arrow.0 == way) {
                    Some((_, numbers)) => numbers.push(number),
                    None => arrows.push((way, vec![number])),
                }
            }
        }
        arrows
    }

    #[test]
    fn the_documentation_shows_this_table_and_its_diagram() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/operators.md");
        let page = std::fs::read_to_string(path).expect("docs/operators.md is there");
        let (before, rest) = page.split_once(FROM).expect("docs/operators.md has the mark where the table begins");
        let (shown, after) = rest.split_once(TO).expect("docs/operators.md has the mark where the table ends");
        let expected = documentation();
        if std::env::var_os("CARRIL_UPDATE").is_some() {
            std::fs::write(path, format!("{before}{FROM}{expected}{TO}{after}"))
                .expect("docs/operators.md can be written");
            return;
        }
        assert_eq!(
            shown, expected,
            "docs/operators.md shows another table than the one in use; mend it with \
             CARRIL_UPDATE=1 cargo test --release --locked --workspace --lib -- the_documentation_shows_this_table"
        );
    }
}
