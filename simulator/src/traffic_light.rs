//! Traffic lights beside the lane: what they show when, and where their lamps hang.

use carril_messages::{LightColour, Pose};
use nalgebra::{Point2, Point3, Vector2};

use crate::centre_line::left_of;
use crate::track::{Bgr, Lane};

/// The housing: across, up, and along the lane, m.
pub const HOUSING_M: [f64; 3] = [0.07, 0.16, 0.05];
/// Side of the post, m.
pub const POST_M: f64 = 0.015;
/// Of housing and post.
pub const HOUSING: Bgr = [32; 3];
/// Of a lamp, m.
pub const LAMP_RADIUS_M: f64 = 0.025;
/// The white core of a lamp that is lit, as a share of its radius.
pub const CORE: f64 = 0.55;
/// The red lamp hangs so far above the middle of the housing, the green one so far below, m.
const LAMP_UP_M: f64 = 0.04;

/// A traffic light, with a stop line across the lane.
#[derive(Clone, Debug, PartialEq)]
pub struct TrafficLight {
    /// The near edge of its stop line, along the lane, m.
    pub along_m: f64,
    /// Of the stop line, along the lane, m.
    pub line_width_m: f64,
    /// Its post on the floor, looking along the lane.
    pub post: Pose,
    /// Middle of its housing above the floor, m.
    pub height_m: f64,
    /// What it shows in turn, and for how long, s; `None`: nothing. After the last the first comes again.
    pub phases: Vec<(Option<LightColour>, f64)>,
    /// The first phase has lasted so long at the start, s.
    pub offset_s: f64,
}

/// What a traffic light shows, and for how long it has.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shown {
    /// `None`: nothing.
    pub colour: Option<LightColour>,
    /// s.
    pub for_s: f64,
}

/// A lamp on the front of a housing.
#[derive(Clone, Copy, Debug)]
pub struct HungLamp {
    /// What it means when it is lit.
    pub colour: LightColour,
    /// Its middle in the map.
    pub middle: Point3<f64>,
    /// The direction to its left, as the lane sees it, on the floor.
    pub left: Vector2<f64>,
}

impl TrafficLight {
    /// What it shows so long after the start.
    pub fn shown(&self, elapsed_s: f64) -> Shown {
        let whole: f64 = self.phases.iter().map(|(_, lasts_s)| lasts_s).sum();
        let mut left_s = (elapsed_s + self.offset_s).rem_euclid(whole.max(1e-6));
        for (colour, lasts_s) in &self.phases {
            if left_s < *lasts_s {
                return Shown { colour: *colour, for_s: left_s };
            }
            left_s -= lasts_s;
        }
        Shown { colour: None, for_s: 0.0 }
    }

    /// Its lamps.
    pub fn lamps(&self) -> [HungLamp; 2] {
        let forward = Vector2::new(self.post.yaw_rad.cos(), self.post.yaw_rad.sin());
        // Just before the housing.
        let front = Point2::new(self.post.x_m, self.post.y_m) - forward * (HOUSING_M[2] / 2.0 + 0.002);
        let lamp = |colour, up_m: f64| HungLamp {
            colour,
            middle: Point3::new(front.x, front.y, self.height_m + up_m),
            left: left_of(forward),
        };
        [lamp(LightColour::Red, LAMP_UP_M), lamp(LightColour::Green, -LAMP_UP_M)]
    }

    /// How far it is from a place on the lane to its stop line, m; below 0 behind it.
    pub fn ahead_of(&self, along_m: f64, lane: &Lane) -> f64 {
        let length_m = lane.centre.length_m();
        (self.along_m - along_m + length_m / 2.0).rem_euclid(length_m) - length_m / 2.0
    }
}

impl HungLamp {
    /// Its halo (or all of it, when it is dark) and its core, blue, green, red.
    pub fn colours(&self, lit: bool) -> (Bgr, Option<Bgr>) {
        match (self.colour, lit) {
            (LightColour::Red, true) => ([30, 40, 255], Some([225, 235, 255])),
            (LightColour::Red, false) => ([16, 16, 52], None),
            (_, true) => ([90, 235, 40], Some([235, 255, 230])),
            (_, false) => ([20, 46, 16], None),
        }
    }

    /// The corners of a disc around its middle, counter-clockwise as the traffic sees it.
    pub fn disc(&self, radius_m: f64) -> Vec<Point3<f64>> {
        const CORNERS: usize = 14;
        let corner = |index: usize| {
            let (sin, cos) = (index as f64 / CORNERS as f64 * std::f64::consts::TAU).sin_cos();
            let beside = self.left * (-cos * radius_m);
            self.middle + nalgebra::Vector3::new(beside.x, beside.y, sin * radius_m)
        };
        (0..CORNERS).map(corner).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phases_come_in_turn_for_ever() {
        let light = TrafficLight {
            along_m: 1.0,
            line_width_m: 0.04,
            post: Pose::default(),
            height_m: 0.3,
            phases: vec![(Some(LightColour::Red), 3.0), (Some(LightColour::Green), 2.0), (None, 1.0)],
            offset_s: 1.0,
        };
        let shown = |elapsed_s| light.shown(elapsed_s);
        assert_eq!(shown(0.0), Shown { colour: Some(LightColour::Red), for_s: 1.0 }, "the offset");
        assert_eq!(shown(2.5).colour, Some(LightColour::Green), "after 3 s of red");
        assert_eq!(shown(4.5).colour, None, "dark");
        assert_eq!(shown(5.25), Shown { colour: Some(LightColour::Red), for_s: 0.25 }, "again");
    }
}
