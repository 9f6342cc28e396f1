//! What a message of carril looks like in Foxglove. Pure: a message and what is known about the graph in, a well-known message out.
//! Nothing here invents a measurement: what is not a number is not drawn.

use std::f64::consts::PI;

use carril_messages::{
    DecisionState, DriveState, Header, LaneEstimate, LaserScan, Pose, Sector, Sectors, Stamp, VehicleState,
};
use carril_runtime::control_plane::LogLevel;
use foxglove::bytes::Bytes;
use foxglove::messages::{
    CircleAnnotation, Color, CompressedImage, Duration, FrameTransform, FrameTransforms, ImageAnnotations,
    LinePrimitive, Log, Point2, Point3, PointsAnnotation, PoseInFrame, Quaternion, SceneEntity, SceneUpdate,
    SpherePrimitive, TextAnnotation, TextPrimitive, Timestamp, Vector3, line_primitive, log, points_annotation,
};

/// The map frame of carril (docs/frames-and-units.md).
pub const MAP: &str = "map";
/// The body frame of carril: middle of the rear axle.
pub const BODY: &str = "base_link";
/// The frame of the lidar.
pub const LASER: &str = "laser";

/// From one point of an arc to the next, at most, rad.
const ARC_STEP_RAD: f64 = PI / 36.0;
/// A sector whose limit is unknown is drawn this large, m.
const UNKNOWN_LIMIT_M: f64 = 1.0;
/// What shows the present vanishes when no news come for this long, s.
const LIFETIME_S: i32 = 1;
/// Better estimates of the lane are green, others orange.
const GOOD_QUALITY: f32 = 0.5;

const GREEN: Color = Color { r: 0.1, g: 0.8, b: 0.3, a: 1.0 };
const ORANGE: Color = Color { r: 1.0, g: 0.6, b: 0.0, a: 1.0 };
const RED: Color = Color { r: 0.95, g: 0.15, b: 0.1, a: 1.0 };
const GREY: Color = Color { r: 0.6, g: 0.6, b: 0.6, a: 1.0 };
const BLUE: Color = Color { r: 0.2, g: 0.6, b: 1.0, a: 0.8 };
const WHITE: Color = Color { r: 1.0, g: 1.0, b: 1.0, a: 1.0 };
const SHADE: Color = Color { r: 0.0, g: 0.0, b: 0.0, a: 0.6 };

/// When the oldest exposure was that a sample derives from; without one, when it was published.
pub fn origin(header: &Header) -> Stamp {
    header.origins.oldest().unwrap_or(header.stamp)
}

/// On the car's clock. `None`: before 1970 or after 2106, which no car's clock shows.
pub fn timestamp(stamp: Stamp) -> Option<Timestamp> {
    let seconds = u32::try_from(stamp.as_nanos().div_euclid(1_000_000_000)).ok()?;
    Timestamp::new_checked(seconds, stamp.as_nanos().rem_euclid(1_000_000_000) as u32)
}

/// Time of a message in the protocol, ns.
pub fn log_time(stamp: Stamp) -> u64 {
    u64::try_from(stamp.as_nanos()).unwrap_or(0)
}

/// A JPEG file as a compressed image; its frame is the name of its port.
pub fn picture(jpeg: Bytes, port: &str, stamp: Stamp) -> CompressedImage {
    CompressedImage { timestamp: timestamp(stamp), frame_id: port.to_owned(), data: jpeg, format: "jpeg".to_owned() }
}

/// A scan. `None` when its angles are not numbers.
///
/// Ranges: a return stays as it is; `+inf` (nothing within reach) stays `+inf`; `NaN` (no measurement), `-inf` (too near) and what
/// no device measures (0 and less) become `NaN`. Foxglove draws points for finite ranges only.
pub fn scan(scan: &LaserScan, frame: &str, stamp: Stamp) -> Option<foxglove::messages::LaserScan> {
    let (start, step) = (f64::from(scan.angle_min_rad), f64::from(scan.angle_increment_rad));
    if !(start.is_finite() && step.is_finite()) {
        return None;
    }
    let range = |range: &f32| if *range > 0.0 { f64::from(*range) } else { f64::NAN };
    Some(foxglove::messages::LaserScan {
        timestamp: timestamp(stamp),
        frame_id: frame.to_owned(),
        pose: Some(at(0.0, 0.0, 0.0, 0.0)),
        start_angle: start,
        end_angle: start + step * scan.ranges_m.len().saturating_sub(1) as f64,
        ranges: scan.ranges_m.iter().map(range).collect(),
        intensities: Vec::new(),
    })
}

/// Where the car is on the map. `None` when that is not a number.
pub fn pose(state: &VehicleState, stamp: Stamp) -> Option<PoseInFrame> {
    let Pose { x_m, y_m, yaw_rad } = finite(state.pose_in_map)?;
    Some(PoseInFrame { timestamp: timestamp(stamp), frame_id: MAP.to_owned(), pose: Some(at(x_m, y_m, 0.0, yaw_rad)) })
}

/// The body frame on the map. `None` when that is not a number: it would spoil all that stands on the body frame.
pub fn body_on_map(state: &VehicleState, body: &str, stamp: Stamp) -> Option<FrameTransforms> {
    let Pose { x_m, y_m, yaw_rad } = finite(state.pose_in_map)?;
    Some(FrameTransforms { transforms: vec![transform((MAP, body), (x_m, y_m, yaw_rad), stamp)] })
}

/// The lidars on the body: frame and direction of its x axis, rad, + left.
pub fn lasers_on_body(lasers: &[(String, f64)], stamp: Stamp) -> FrameTransforms {
    let one = |(frame, yaw_rad): &(String, f64)| transform((BODY, frame), (0.0, 0.0, *yaw_rad), stamp);
    FrameTransforms { transforms: lasers.iter().map(one).collect() }
}

fn transform((parent, child): (&str, &str), (x_m, y_m, yaw_rad): (f64, f64, f64), stamp: Stamp) -> FrameTransform {
    FrameTransform {
        timestamp: timestamp(stamp),
        parent_frame_id: parent.to_owned(),
        child_frame_id: child.to_owned(),
        translation: Some(Vector3 { x: x_m, y: y_m, z: 0.0 }),
        rotation: Some(turned(yaw_rad)),
    }
}

fn finite(pose: Pose) -> Option<Pose> {
    (pose.x_m.is_finite() && pose.y_m.is_finite() && pose.yaw_rad.is_finite()).then_some(pose)
}

/// About the upward axis, + left.
fn turned(yaw_rad: f64) -> Quaternion {
    Quaternion { x: 0.0, y: 0.0, z: (yaw_rad / 2.0).sin(), w: (yaw_rad / 2.0).cos() }
}

fn at(x: f64, y: f64, z: f64, yaw_rad: f64) -> foxglove::messages::Pose {
    foxglove::messages::Pose { position: Some(Vector3 { x, y, z }), orientation: Some(turned(yaw_rad)) }
}

/// An image that a detector reads, and how large it is shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    size: (f64, f64),
    scale: (f64, f64),
}

impl Frame {
    /// An image of this size that [`compress`](crate::pictures::compress) shows at most `max_width` px wide.
    pub fn new((width, height): (u32, u32), max_width: u32) -> Self {
        let max_width = max_width.max(1);
        if width <= max_width {
            return Self::shown_as((width, height), (width, height));
        }
        let shown_height = u64::from(height) * u64::from(max_width) / u64::from(width.max(1));
        Self::shown_as((width, height), (max_width, shown_height.max(1) as u32))
    }

    /// An image of this size that is shown in that one.
    pub fn shown_as((width, height): (u32, u32), shown: (u32, u32)) -> Self {
        let share = |shown: u32, whole: u32| f64::from(shown) / f64::from(whole.max(1));
        let scale = (share(shown.0, width), share(shown.1, height));
        Self { size: (f64::from(width), f64::from(height)), scale }
    }

    /// From the lane's frame (middle of the bottom row, up, left; middles of pixels) to that of Foxglove: from the top left corner.
    fn point(&self, left_px: f64, ahead_px: f64) -> Point2 {
        Point2 { x: (self.size.0 / 2.0 - left_px) * self.scale.0, y: (self.size.1 - 0.5 - ahead_px) * self.scale.1 }
    }

    /// A whole row, at a share of the height from the top.
    fn row(&self, share: f64) -> [Point2; 2] {
        let y = share * self.size.1 * self.scale.1;
        [Point2 { x: 0.0, y }, Point2 { x: self.size.0 * self.scale.0, y }]
    }

    fn shown_height(&self) -> f64 {
        self.size.1 * self.scale.1
    }
}

/// A lane drawn over the image that it was found in. `rows`: where the detector looks, shares of the height from the top, used when
/// there is no lane whose centroids would tell.
pub fn overlay(estimate: &LaneEstimate, frame: Frame, rows: Option<[f64; 2]>, stamp: Stamp) -> ImageAnnotations {
    let time = timestamp(stamp);
    let lane = estimate
        .lane
        .filter(|lane| [lane.far, lane.near].iter().all(|dot| dot.left_px.is_finite() && dot.ahead_px.is_finite()));
    let colour = if estimate.quality >= GOOD_QUALITY { GREEN } else { ORANGE };
    let unit = (frame.shown_height() / 160.0).max(1.0);
    let stroke = |points: Vec<Point2>, colour: Color, thickness: f64| PointsAnnotation {
        timestamp: time,
        r#type: points_annotation::Type::LineList as i32,
        points,
        outline_color: Some(colour),
        thickness,
        ..PointsAnnotation::default()
    };
    let mut drawn = ImageAnnotations { timestamp: time, ..ImageAnnotations::default() };
    if let Some(lane) = lane {
        let dots = [lane.far, lane.near];
        let place = |left: f32, ahead: f32| frame.point(f64::from(left), f64::from(ahead));
        let [far, near] = dots.map(|dot| place(dot.left_px, dot.ahead_px));
        let rows = [far, near].iter().flat_map(|dot| frame.row(dot.y / frame.shown_height())).collect();
        drawn.points.push(stroke(rows, BLUE, unit / 2.0));
        drawn.points.push(stroke(vec![far, near], colour, unit));
        drawn.circles.extend([far, near].map(|position| CircleAnnotation {
            timestamp: time,
            position: Some(position),
            diameter: 5.0 * unit,
            thickness: unit / 2.0,
            fill_color: Some(colour),
            outline_color: Some(WHITE),
            metadata: Vec::new(),
        }));
    } else if let Some(rows) = rows.filter(|rows| rows.iter().all(|row| (0.0..=1.0).contains(row))) {
        drawn.points.push(stroke(rows.iter().flat_map(|row| frame.row(*row)).collect(), BLUE, unit / 2.0));
    }
    let font_size = 5.0 * unit;
    drawn.texts.push(TextAnnotation {
        timestamp: time,
        position: Some(Point2 { x: 2.0 * unit, y: 2.0 * unit + font_size }),
        text: lane_text(estimate, lane.is_some()),
        font_size,
        text_color: Some(if lane.is_some() { colour } else { RED }),
        background_color: Some(SHADE),
        metadata: Vec::new(),
    });
    drawn
}

/// `lane 0.87, threshold 190`
fn lane_text(estimate: &LaneEstimate, shown: bool) -> String {
    let found = match (shown, estimate.lane.is_some()) {
        (true, _) => format!("lane {:.2}", estimate.quality),
        (false, true) => "lane that is not a number".to_owned(),
        (false, false) => "no lane".to_owned(),
    };
    let threshold = estimate.threshold.map(|threshold| format!(", threshold {threshold}"));
    found + threshold.as_deref().unwrap_or_default()
}

/// The sectors around the car: outline up to the limit, an arc at the nearest return; occupied is red, free green, blind grey.
/// `limit_m`: the limit of a sector by its name, if it is known.
pub fn sectors(sectors: &Sectors, limit_m: impl Fn(&str) -> Option<f64>, stamp: Stamp) -> SceneUpdate {
    let entities = sectors.sectors.iter().filter_map(|one| sector(one, limit_m(&one.name), stamp)).collect();
    SceneUpdate { deletions: Vec::new(), entities }
}

/// `None` when its edges are not numbers.
fn sector(sector: &Sector, limit_m: Option<f64>, stamp: Stamp) -> Option<SceneEntity> {
    let (from, to) = (f64::from(sector.from_rad), f64::from(sector.to_rad));
    if !(from.is_finite() && to.is_finite() && from <= to) {
        return None;
    }
    let colour = match sector {
        Sector { occupied: true, .. } => RED,
        Sector { coverage, .. } if *coverage > 0.0 => GREEN,
        _ => GREY,
    };
    let nearest = sector.nearest_m.map(f64::from).filter(|range| range.is_finite() && *range >= 0.0);
    let limit = limit_m.filter(|limit| limit.is_finite() && *limit > 0.0).unwrap_or(UNKNOWN_LIMIT_M);
    let outline = std::iter::once(on_floor(0.0, 0.0)).chain(arc(from, to, limit)).collect();
    let mut lines = vec![line(line_primitive::Type::LineLoop, outline, 1.0, colour)];
    lines.extend(
        nearest.map(|range| line(line_primitive::Type::LineStrip, arc(from, to, range).collect(), 3.0, colour)),
    );
    let dot =
        nearest.zip(sector.nearest_bearing_rad).filter(|(_, bearing)| bearing.is_finite()).map(|(range, bearing)| {
            let place = on_floor(range, f64::from(bearing));
            let size = Vector3 { x: 0.04, y: 0.04, z: 0.04 };
            SpherePrimitive { pose: Some(at(place.x, place.y, 0.0, 0.0)), size: Some(size), color: Some(colour) }
        });
    let middle = on_floor(limit, f64::midpoint(from, to));
    let text = TextPrimitive {
        pose: Some(at(middle.x, middle.y, 0.0, 0.0)),
        billboard: true,
        font_size: 12.0,
        scale_invariant: true,
        color: Some(colour),
        text: sector_text(sector, nearest),
    };
    Some(SceneEntity {
        timestamp: timestamp(stamp),
        frame_id: BODY.to_owned(),
        id: sector.name.clone(),
        lifetime: Some(Duration::new(LIFETIME_S, 0)),
        frame_locked: true,
        lines,
        spheres: dot.into_iter().collect(),
        texts: vec![text],
        ..SceneEntity::default()
    })
}

/// `front 0.82 m`, `rear blind`
fn sector_text(sector: &Sector, nearest: Option<f64>) -> String {
    match nearest {
        Some(range) => format!("{} {range:.2} m", sector.name),
        None if sector.coverage > 0.0 => sector.name.clone(),
        None => format!("{} blind", sector.name),
    }
}

/// From `from` to `to` rad, counter-clockwise. At most one turn is drawn.
fn arc(from: f64, to: f64, radius: f64) -> impl Iterator<Item = Point3> {
    let span = (to - from).min(2.0 * PI);
    let steps = (span / ARC_STEP_RAD).ceil().max(1.0) as u32;
    (0..=steps).map(move |step| on_floor(radius, from + span * f64::from(step) / f64::from(steps)))
}

fn on_floor(range: f64, bearing_rad: f64) -> Point3 {
    Point3 { x: range * bearing_rad.cos(), y: range * bearing_rad.sin(), z: 0.0 }
}

fn line(kind: line_primitive::Type, points: Vec<Point3>, thickness_px: f64, colour: Color) -> LinePrimitive {
    LinePrimitive {
        r#type: kind as i32,
        pose: Some(at(0.0, 0.0, 0.0, 0.0)),
        thickness: thickness_px,
        scale_invariant: true,
        points,
        color: Some(colour),
        colors: Vec::new(),
        indices: Vec::new(),
    }
}

/// A line of the log.
pub fn log(stamp: Stamp, level: LogLevel, name: &str, text: &str) -> Log {
    let level = match level {
        LogLevel::Error => log::Level::Error,
        LogLevel::Warning => log::Level::Warning,
        LogLevel::Info => log::Level::Info,
        LogLevel::Debug => log::Level::Debug,
    };
    Log {
        timestamp: timestamp(stamp),
        level: level as i32,
        message: text.to_owned(),
        name: name.to_owned(),
        file: String::new(),
        line: 0,
    }
}

/// What a state of the decision node says that `before` did not: `lane-follow -> obstacle-stop: front 0.4 m`. `None`: nothing new.
pub fn transition(before: Option<&DecisionState>, now: &DecisionState) -> Option<(LogLevel, String)> {
    let level = match now.state {
        DriveState::EStop => LogLevel::Error,
        DriveState::ObstacleStop
        | DriveState::LightStop
        | DriveState::LaneLost
        | DriveState::OvertakeWait
        | DriveState::OvertakeStop
        | DriveState::ParkStop => LogLevel::Warning,
        _ => LogLevel::Info,
    };
    let Some(before) = before else {
        return Some((level, format!("{}: {}", now.state.name(), now.reason)));
    };
    if (before.state, before.transitions) == (now.state, now.transitions) {
        return None;
    }
    let unseen = now.transitions.saturating_sub(before.transitions).saturating_sub(1);
    let between = if unseen > 0 { format!(" (after {unseen} more in between)") } else { String::new() };
    Some((level, format!("{} -> {}{between}: {}", before.state.name(), now.state.name(), now.reason)))
}

#[cfg(test)]
#[path = "show_tests.rs"]
mod tests;
