//! Each well-known message against what it should say, number by number.

use carril_messages::{Centroid, Lane, MessageType, Meta, Origins, SourceId};
use foxglove::{Decode, Encode};

use super::*;

const STAMP: Stamp = Stamp::from_nanos(12_000_000_345);

fn header(origins: Origins) -> Header {
    let message_type = MessageType::new("carril/Any", 1);
    Header { epoch: 0, seq: 0, stamp: Stamp::from_nanos(9), origins, message_type, meta: Meta::new() }
}

fn assert_near(got: f64, expected: f64, what: &str) {
    assert!((got - expected).abs() < 1e-6, "{what}: got {got}, expected {expected}");
}

/// What a viewer reads from the bytes is what was meant.
fn assert_travels<T: Encode + Decode + PartialEq + std::fmt::Debug>(message: &T) {
    let bytes = crate::foxglove::hub::encoded(message);
    assert_eq!(&T::decode(&bytes[..]).expect("our own bytes"), message, "there and back");
}

#[test]
fn times_are_those_of_the_car() {
    assert_eq!(timestamp(STAMP), Some(Timestamp::new(12, 345)), "seconds and the rest");
    assert_eq!(timestamp(Stamp::from_nanos(-1)), None, "before the epoch there is no time");
    assert_eq!(timestamp(Stamp::from_nanos(i64::MAX)), None, "nor long after it");
    assert_eq!(log_time(Stamp::from_nanos(-1)), 0, "never a huge time by wrapping");
    assert_eq!(origin(&header(Origins::none())), Stamp::from_nanos(9), "no exposure: when it was published");
    let captured = Origins::captured(SourceId::of("world", "camera"), Stamp::from_nanos(5));
    assert_eq!(origin(&header(captured)), Stamp::from_nanos(5), "when the exposure was");
}

#[test]
fn a_picture_says_what_it_is() {
    let shown = picture(vec![1, 2, 3].into(), "world/camera", STAMP);
    assert_eq!((shown.format.as_str(), &shown.data[..]), ("jpeg", &[1, 2, 3][..]), "the file as it is");
    assert_eq!((shown.frame_id.as_str(), shown.timestamp), ("world/camera", timestamp(STAMP)), "whose, and when");
    assert_travels(&shown);
}

fn measured(ranges_m: Vec<f32>) -> LaserScan {
    let (angle_min_rad, angle_increment_rad) = (-1.5, 0.5);
    LaserScan { angle_min_rad, angle_increment_rad, scan_time_s: 0.1, range_min_m: 0.1, range_max_m: 8.0, ranges_m }
}

#[test]
fn a_scan_keeps_returns_and_invents_none() {
    let shown = scan(&measured(vec![0.5, f32::INFINITY, f32::NAN, f32::NEG_INFINITY, 0.0, -1.0, 2.0]), LASER, STAMP)
        .expect("its angles are numbers");
    assert_eq!((shown.start_angle, shown.end_angle), (-1.5, 1.5), "the angles of the first and the last point");
    assert_eq!(shown.ranges.len(), 7, "a point keeps its place");
    assert_eq!((shown.ranges[0], shown.ranges[6]), (0.5, 2.0), "returns");
    assert_eq!(shown.ranges[1], f64::INFINITY, "nothing within reach");
    assert!(shown.ranges[2..6].iter().all(|range| range.is_nan()), "no measurement: {:?}", shown.ranges);
    assert_eq!(shown.frame_id, "laser", "where it is");
}

#[test]
fn an_empty_scan_is_one_and_a_senseless_one_is_not() {
    let empty = scan(&measured(Vec::new()), LASER, STAMP).expect("an empty scan is a scan");
    assert_eq!((empty.start_angle, empty.end_angle, empty.ranges.len()), (-1.5, -1.5, 0), "no point");
    assert_travels(&empty);
    assert!(scan(&LaserScan { angle_min_rad: f32::NAN, ..measured(vec![1.0]) }, LASER, STAMP).is_none(), "start");
    let endless = LaserScan { angle_increment_rad: f32::INFINITY, ..measured(vec![1.0]) };
    assert!(scan(&endless, LASER, STAMP).is_none(), "step");
}

fn vehicle(yaw_rad: f64) -> VehicleState {
    let pose_in_map = Pose { x_m: 1.0, y_m: -2.0, yaw_rad };
    VehicleState { pose_in_map, speed_m_s: 0.5, yaw_rate_rad_s: 0.0, steering_rad: 0.1 }
}

#[test]
fn a_vehicle_is_a_pose_and_a_frame() {
    let shown = pose(&vehicle(PI / 2.0), STAMP).expect("its pose is numbers");
    assert_eq!(shown.frame_id, "map", "on the map");
    let placed = shown.pose.expect("it has a pose");
    assert_eq!(placed.position, Some(Vector3 { x: 1.0, y: -2.0, z: 0.0 }), "where");
    let turn = placed.orientation.expect("it has a direction");
    assert_eq!((turn.x, turn.y), (0.0, 0.0), "level");
    assert_near(turn.z, 0.5_f64.sqrt(), "a quarter turn to the left");
    assert_near(turn.w, 0.5_f64.sqrt(), "a quarter turn to the left");
    assert_travels(&shown);

    let frames = body_on_map(&vehicle(0.0), BODY, STAMP).expect("its pose is numbers").transforms;
    assert_eq!(
        (frames[0].parent_frame_id.as_str(), frames[0].child_frame_id.as_str(), frames[0].timestamp),
        ("map", "base_link", timestamp(STAMP)),
        "the body on the map, at that time"
    );
    assert_eq!(frames[0].rotation, Some(Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }), "not turned");
    assert!(pose(&vehicle(f64::NAN), STAMP).is_none(), "a car that is nowhere is not drawn at 0");
    assert!(body_on_map(&vehicle(f64::INFINITY), BODY, STAMP).is_none(), "nor are its frames");
}

#[test]
fn lidars_sit_on_the_body_as_they_are_mounted() {
    let frames = lasers_on_body(&[(LASER.to_owned(), 0.0), ("rear/scan".to_owned(), PI)], STAMP).transforms;
    let names = frames.iter().map(|one| format!("{} {}", one.parent_frame_id, one.child_frame_id));
    assert_eq!(names.collect::<Vec<_>>(), ["base_link laser", "base_link rear/scan"], "each one");
    assert_eq!(frames[0].rotation.map(|turn| turn.w), Some(1.0), "ahead");
    assert_near(frames[1].rotation.expect("turned").z, 1.0, "backwards");
}

fn estimate(far: (f32, f32), near: (f32, f32)) -> LaneEstimate {
    let dot = |(left_px, ahead_px)| Centroid { left_px, ahead_px, pixels: 4 };
    let lane =
        Lane { angle_rad: 0.0, distance_px: 0.0, distance_m: None, ground: None, far: dot(far), near: dot(near) };
    LaneEstimate { lane: Some(lane), quality: 0.871, threshold: Some(190) }
}

fn place(point: Option<Point2>) -> (f64, f64) {
    point.map(|point| (point.x, point.y)).expect("it is somewhere")
}

#[test]
fn rows_and_columns_are_found_again_in_the_picture() {
    // The detector's sums: column c is (width - 1) / 2 - left, row r is height - 1 - ahead; the middle of a pixel lies half a pixel in.
    let (width, height) = (640, 480);
    let (column, row) = (100.0, 360.0);
    let (left, ahead) = ((639.0 - 2.0 * column) / 2.0, 479.0 - row);
    let shown = overlay(&estimate((left, ahead), (0.0, 0.0)), Frame::new((width, height), 640), None, STAMP);
    assert_eq!(place(shown.circles[0].position), (100.5, 360.5), "the far centroid: middle of its pixel");
    assert_eq!(place(shown.circles[1].position), (320.0, 479.5), "the origin: middle of the bottom row");
    let [rows, line] = &shown.points[..] else { panic!("rows and the line: {:?}", shown.points) };
    let ends: Vec<(f64, f64)> = rows.points.iter().map(|point| (point.x, point.y)).collect();
    assert_eq!(ends, [(0.0, 360.5), (640.0, 360.5), (0.0, 479.5), (640.0, 479.5)], "from edge to edge");
    let ends: Vec<(f64, f64)> = line.points.iter().map(|point| (point.x, point.y)).collect();
    assert_eq!(ends, [(100.5, 360.5), (320.0, 479.5)], "from far to near");
    assert_eq!(shown.texts[0].text, "lane 0.87, threshold 190", "how good it is");
    assert_travels(&shown);
}

#[test]
fn an_overlay_shrinks_with_its_picture() {
    let shown = overlay(&estimate((100.0, 239.5), (0.0, 0.0)), Frame::new((1280, 720), 640), None, STAMP);
    assert_eq!(place(shown.circles[0].position), (270.0, 240.0), "half as far from the corner");
    let picture = crate::pictures::compress(
        &carril_messages::Image::packed(1280, 721, carril_messages::Encoding::Mono8, vec![0; 1280 * 721].into())
            .expect("it fits"),
        640,
        75,
    );
    let (size, frame) = (picture.expect("it is an image"), Frame::new((1280, 721), 640));
    assert_near(frame.shown_height(), f64::from(size.height), "an odd height is rounded as the picture's");
    assert_eq!(Frame::new((320, 240), 640).scale, (1.0, 1.0), "small ones are not enlarged");
    let afar = Frame::shown_as((1280, 720), (480, 270));
    let there = afar.point(100.0, 239.5);
    assert_near(there.x, 202.5, "a picture that was compressed elsewhere has its own scale");
    assert_near(there.y, 180.0, "in both directions");
    assert!(Frame::new((320, 1), 0).shown_height() >= 1.0, "a width that is none is 1");
}

#[test]
fn without_a_lane_there_are_rows_and_a_word() {
    let none = LaneEstimate { lane: None, quality: 0.0, threshold: None };
    let frame = Frame::new((64, 48), 640);
    let shown = overlay(&none, frame, Some([0.5, 0.75]), STAMP);
    assert!(shown.circles.is_empty(), "no centroid");
    let rows: Vec<f64> = shown.points[0].points.iter().map(|point| point.y).collect();
    assert_eq!(rows, [24.0, 24.0, 36.0, 36.0], "where it looks");
    assert_eq!(shown.texts[0].text, "no lane", "what it says");
    assert!(overlay(&none, frame, None, STAMP).points.is_empty(), "where it looks is unknown");
    assert!(overlay(&none, frame, Some([0.5, f64::NAN]), STAMP).points.is_empty(), "no number, no row");
    let broken = overlay(&estimate((f32::NAN, 3.0), (0.0, 0.0)), frame, None, STAMP);
    assert!(broken.circles.is_empty() && broken.points.is_empty(), "what is not a number is not drawn");
    assert_eq!(broken.texts[0].text, "lane that is not a number, threshold 190", "and it says so");
}

fn front() -> Sector {
    Sector {
        name: "front".into(),
        from_rad: -0.5,
        to_rad: 0.5,
        nearest_m: Some(0.82),
        nearest_bearing_rad: Some(0.25),
        returns_within: 5,
        occupied: true,
        coverage: 1.0,
    }
}

fn drawn(sector: Sector, limit: Option<f64>) -> Option<SceneEntity> {
    let update = sectors(&Sectors { sectors: vec![sector] }, |_| limit, STAMP);
    assert_travels(&update);
    update.entities.into_iter().next()
}

#[test]
fn an_occupied_sector_is_red_up_to_its_limit_with_an_arc_at_the_nearest_return() {
    let shown = drawn(front(), Some(1.2)).expect("its edges are numbers");
    assert_eq!((shown.id.as_str(), shown.frame_id.as_str()), ("front", "base_link"), "which, where");
    assert_eq!(shown.lines[0].color, Some(RED), "occupied");
    let reach = |at: usize| shown.lines[at].points.iter().map(|point| point.x.hypot(point.y)).fold(0.0, f64::max);
    assert_near(reach(0), 1.2, "the outline ends at the limit");
    assert_near(reach(1), f64::from(0.82_f32), "the arc lies at the return");
    let first = shown.lines[1].points[0];
    assert_near(first.y.atan2(first.x), -0.5, "from the right edge");
    let last = shown.lines[1].points.last().expect("an arc has an end");
    assert_near(last.y.atan2(last.x), 0.5, "to the left edge");
    assert_eq!(shown.spheres.len(), 1, "the return itself");
    assert_eq!(shown.texts[0].text, "front 0.82 m", "in words");
    assert_eq!(shown.lifetime, Some(Duration::new(1, 0)), "it does not outlive its news");
}

#[test]
fn a_free_sector_is_green_and_a_blind_one_grey() {
    let free = Sector { nearest_m: None, nearest_bearing_rad: None, returns_within: 0, occupied: false, ..front() };
    let shown = drawn(free.clone(), None).expect("its edges are numbers");
    assert_eq!((shown.lines[0].color, shown.lines.len()), (Some(GREEN), 1), "nothing there: only its outline");
    assert_eq!((shown.spheres.len(), shown.texts[0].text.as_str()), (0, "front"), "no distance is made up");
    let shown = drawn(Sector { coverage: 0.0, ..free }, None).expect("its edges are numbers");
    assert_eq!((shown.lines[0].color, shown.texts[0].text.as_str()), (Some(GREY), "front blind"), "it cannot see");
}

#[test]
fn a_senseless_sector_is_left_out() {
    assert!(drawn(Sector { from_rad: f32::NAN, ..front() }, None).is_none(), "edge");
    assert!(drawn(Sector { to_rad: f32::INFINITY, ..front() }, None).is_none(), "other edge");
    assert!(drawn(Sector { from_rad: 1.0, to_rad: -1.0, ..front() }, None).is_none(), "edges the wrong way round");
    let huge = drawn(Sector { from_rad: -1e30, to_rad: 1e30, ..front() }, None).expect("its edges are numbers");
    assert!(huge.lines[0].points.len() < 100, "one turn at most, not {}", huge.lines[0].points.len());
    let odd = Sector { nearest_m: Some(f32::NAN), nearest_bearing_rad: Some(f32::NAN), ..front() };
    let shown = drawn(odd, Some(f64::NAN)).expect("its edges are numbers");
    assert_eq!((shown.lines.len(), shown.spheres.len()), (1, 0), "no return that is not a number");
    assert!(sectors(&Sectors { sectors: Vec::new() }, |_| None, STAMP).entities.is_empty(), "none");
}

#[test]
fn lines_of_the_log_keep_level_time_and_name() {
    let shown = log(STAMP, LogLevel::Warning, "lane", "the light is odd");
    assert_eq!((shown.level, shown.timestamp), (log::Level::Warning as i32, timestamp(STAMP)), "level and time");
    assert_eq!((shown.name.as_str(), shown.message.as_str()), ("lane", "the light is odd"), "who and what");
    let levels = [LogLevel::Debug, LogLevel::Info, LogLevel::Warning, LogLevel::Error];
    let numbers: Vec<i32> = levels.iter().map(|level| log(STAMP, *level, "", "").level).collect();
    assert_eq!(numbers, [1, 2, 3, 4], "as Foxglove counts them");
}

fn state(state: DriveState, transitions: u64) -> DecisionState {
    let (target_speed_m_s, steering_rad) = (0.0, 0.0);
    DecisionState { state, since: STAMP, reason: "front 0.40 m".into(), target_speed_m_s, steering_rad, transitions }
}

#[test]
fn transitions_are_told_once() {
    let (follow, stop) = (state(DriveState::LaneFollow, 3), state(DriveState::ObstacleStop, 4));
    assert_eq!(
        transition(None, &follow),
        Some((LogLevel::Info, "lane-follow: front 0.40 m".into())),
        "the first state that is heard"
    );
    assert_eq!(transition(Some(&follow), &follow), None, "no news");
    assert_eq!(
        transition(Some(&follow), &stop),
        Some((LogLevel::Warning, "lane-follow -> obstacle-stop: front 0.40 m".into())),
        "from, to and why"
    );
    let later = state(DriveState::EStop, 7);
    assert_eq!(
        transition(Some(&follow), &later),
        Some((LogLevel::Error, "lane-follow -> e-stop (after 3 more in between): front 0.40 m".into())),
        "what was too quick to be seen is counted"
    );
    let (level, text) = transition(Some(&stop), &state(DriveState::ObstacleStop, 6)).expect("left and entered again");
    assert!(level == LogLevel::Warning && text.contains("(after 1 more in between)"), "{text}");
    assert!(transition(Some(&later), &state(DriveState::Idle, 0)).is_some(), "a restarted node counts anew");
}
