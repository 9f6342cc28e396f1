//! Readable text of every message type of ours, for `echo`. Angles are shown in degrees here, and only here.

use carril_messages::{
    Centroid, CodecError, Command, CompressedImage, Control, DecisionState, Goal, Header, Health, Image, Lane,
    LaneEstimate, LaserScan, McuPins, McuSensors, Message, MessageType, Payload, Sector, Sectors, TrackProgress,
    TrafficLight, VehicleState, WheelTelemetry,
};

use super::{output, time};

/// A sample as text of one or more lines. Types that are not ours are shown by their name and size.
pub fn of(header: &Header, payload: &Payload) -> Result<String, CodecError> {
    let known = known();
    let Some((message_type, show)) = known.iter().find(|(known, _)| known.name == header.message_type.name) else {
        return Ok(format!("{} of `{}`, a type of your own", output::bytes(payload.len() as f64), header.message_type));
    };
    if *message_type != header.message_type {
        let (got, expected) = (header.message_type.to_string(), message_type.to_string());
        return Err(CodecError::WrongType { got, expected });
    }
    show(&header.meta, payload)
}

type Show = fn(&[u8], &Payload) -> Result<String, CodecError>;

fn known() -> [(MessageType, Show); 16] {
    [
        entry::<Image>(),
        entry::<CompressedImage>(),
        entry::<LaserScan>(),
        entry::<Sectors>(),
        entry::<LaneEstimate>(),
        entry::<TrafficLight>(),
        entry::<Command>(),
        entry::<Goal>(),
        entry::<Control>(),
        entry::<WheelTelemetry>(),
        entry::<VehicleState>(),
        entry::<TrackProgress>(),
        entry::<DecisionState>(),
        entry::<Health>(),
        entry::<McuPins>(),
        entry::<McuSensors>(),
    ]
}

fn entry<T: Message + Readable>() -> (MessageType, Show) {
    (T::TYPE, |meta, payload| Ok(T::decode(meta, payload)?.readable()))
}

/// What people read.
trait Readable {
    fn readable(&self) -> String;
}

/// `3.2° left`, for angles that are + to the left.
fn angle(rad: f32) -> String {
    sided(rad.to_degrees(), 1, "°")
}

/// `0.042 m right`, for values that are + to the left.
fn sided(value: f32, digits: usize, unit: &str) -> String {
    let side = if value > 0.0 {
        " left"
    } else if value < 0.0 {
        " right"
    } else {
        ""
    };
    format!("{:.digits$}{unit}{side}", value.abs())
}

fn or_none<T>(value: Option<T>, show: impl FnOnce(T) -> String) -> String {
    value.map_or_else(|| "none".to_owned(), show)
}

impl Readable for CompressedImage {
    fn readable(&self) -> String {
        let bytes = output::bytes(self.jpeg.len() as f64);
        format!(
            "{}x{} jpeg, {bytes}, of {}x{} {}",
            self.width, self.height, self.source_width, self.source_height, self.source_encoding
        )
    }
}

impl Readable for Image {
    fn readable(&self) -> String {
        let (width, height, encoding) = (self.width(), self.height(), self.encoding());
        let packed = width as usize * encoding.bytes_per_pixel();
        let padding = if self.stride() as usize == packed { "" } else { ", rows padded" };
        format!("{width}x{height} {encoding}, {} B{padding}", self.pixels().len())
    }
}

impl Readable for LaserScan {
    fn readable(&self) -> String {
        let count = self.ranges_m.len();
        let last = self.angle_min_rad + self.angle_increment_rad * count.saturating_sub(1) as f32;
        let finite = self.ranges_m.iter().enumerate().filter(|(_, range)| range.is_finite());
        let nearest = finite.min_by(|left, right| left.1.total_cmp(right.1)).map_or_else(
            || "no return".to_owned(),
            |(index, range)| {
                let bearing = self.angle_min_rad + self.angle_increment_rad * index as f32;
                format!("nearest {range:.2} m at {}", angle(bearing))
            },
        );
        let free = self.ranges_m.iter().filter(|range| **range == f32::INFINITY).count();
        let holes = self.ranges_m.iter().filter(|range| range.is_nan()).count();
        let (from, to) = (self.angle_min_rad.to_degrees(), last.to_degrees());
        format!("{count} points from {from:.1}° to {to:.1}°, {nearest}, {free} free, {holes} without measurement")
    }
}

impl Readable for Sectors {
    fn readable(&self) -> String {
        let width = self.sectors.iter().map(|sector| sector.name.chars().count()).max().unwrap_or(0);
        let lines: Vec<String> = self.sectors.iter().map(|sector| sector_line(sector, width)).collect();
        if lines.is_empty() { "no sectors".to_owned() } else { lines.join("\n") }
    }
}

fn sector_line(sector: &Sector, width: usize) -> String {
    let state = if sector.occupied { "OCCUPIED" } else { "free" };
    let nearest = match (sector.nearest_m, sector.nearest_bearing_rad) {
        (Some(range), Some(bearing)) => format!("nearest {range:.2} m at {}", angle(bearing)),
        (Some(range), None) => format!("nearest {range:.2} m"),
        (None, _) => "no return".to_owned(),
    };
    let returns = output::counted(u64::from(sector.returns_within), "return");
    let seen = sector.coverage * 100.0;
    format!("{:<width$}  {state:<8}  {nearest}, {returns} within the limit, {seen:.0} % seen", sector.name)
}

impl Readable for LaneEstimate {
    fn readable(&self) -> String {
        let threshold = or_none(self.threshold, |grey| grey.to_string());
        match &self.lane {
            Some(lane) => format!("{}, quality {:.2}, threshold {threshold}", lane_text(lane), self.quality),
            None => format!("no lane, threshold {threshold}"),
        }
    }
}

fn lane_text(lane: &Lane) -> String {
    let metres = lane.distance_m.map(|metres| format!(" ({})", sided(metres, 3, " m"))).unwrap_or_default();
    let point = |at: &Centroid| format!("{} of {} px", sided(at.left_px, 1, " px"), at.pixels);
    let (far, near) = (point(&lane.far), point(&lane.near));
    let distance = sided(lane.distance_px, 1, " px");
    format!("lane at angle {}, distance {distance}{metres}, far {far}, near {near}", angle(lane.angle_rad))
}

impl Readable for TrafficLight {
    fn readable(&self) -> String {
        let colour = self.colour.map_or("no light", |colour| colour.name());
        let lamp = self.lamp.map(|lamp| {
            let (column, row, radius) = (lamp.column_px, lamp.row_px, lamp.radius_px);
            format!(", a {} lamp at column {column:.0}, row {row:.0}, radius {radius:.1} px", lamp.colour.name())
        });
        let line = self.stop_line_m.map(|ahead| format!(", stop line {ahead:.2} m ahead of the rear axle"));
        format!("{colour}{}{}", lamp.unwrap_or_default(), line.unwrap_or_default())
    }
}

impl Readable for Command {
    fn readable(&self) -> String {
        format!("steering {}, speed {:.2} m/s", angle(self.steering_rad), self.speed_m_s)
    }
}

impl Readable for Goal {
    fn readable(&self) -> String {
        match self {
            Self::Cruise { speed_m_s } => format!("cruise at {speed_m_s:.2} m/s"),
            Self::Park(parking) => format!("park, {}", parking.name()),
            other => format!("{other:?}"),
        }
    }
}

impl Readable for Control {
    fn readable(&self) -> String {
        self.to_string()
    }
}

impl Readable for WheelTelemetry {
    fn readable(&self) -> String {
        let faults: Vec<&str> = self.faults.iter().map(carril_messages::Fault::text).collect();
        let faults = if faults.is_empty() { "no fault".to_owned() } else { format!("FAULT: {}", faults.join("; ")) };
        format!(
            "speed {:.2} m/s, steering {}, {} ticks (period {}), battery {}, {}, last command {} (round trip {}), {}, {faults}",
            self.speed_m_s,
            angle(self.steering_rad),
            self.ticks,
            or_none(self.tick_period_us, |us| format!("{us} µs")),
            or_none(self.battery_v, |volts| format!("{volts:.2} V")),
            if self.driving { "driving" } else { "motor off" },
            or_none(self.last_command_seq, |seq| format!("#{seq}")),
            or_none(self.round_trip_us, |us| format!("{us} µs")),
            line_quality(self.frames_lost, self.frames_damaged),
        )
    }
}

fn line_quality(lost: u32, damaged: u32) -> String {
    if (lost, damaged) == (0, 0) { "line clean".to_owned() } else { format!("{lost} frames lost, {damaged} damaged") }
}

impl Readable for VehicleState {
    fn readable(&self) -> String {
        let pose = &self.pose_in_map;
        format!(
            "x {:.3} m, y {:.3} m, heading {:.1}°, speed {:.2} m/s, turn {:.2} rad/s, steering {}",
            pose.x_m,
            pose.y_m,
            pose.yaw_rad.to_degrees(),
            self.speed_m_s,
            self.yaw_rate_rad_s,
            angle(self.steering_rad)
        )
    }
}

impl Readable for TrackProgress {
    fn readable(&self) -> String {
        let lap = or_none(self.last_lap_s, |seconds| format!("{seconds:.2} s"));
        let wheels = if self.outside { "a wheel is OUTSIDE" } else { "inside the lane" };
        let at_line = self.stopped_before_line_m.map(|ahead| format!(", last stood {ahead:.2} m before a stop line"));
        let clearance = self.clearance_min_m.map(|nearest| format!(", nearest {nearest:.2} m"));
        let red = if self.red_runs > 0 { format!(", RED RUN {} times", self.red_runs) } else { String::new() };
        format!(
            "lap {}, last lap {lap}, {:.2} m driven, {} of the middle (rms {:.3}, max {:.3} m), {wheels}, {}, {}{}{}{red}",
            self.laps,
            self.distance_m,
            sided(self.cross_track_m, 3, " m"),
            self.cross_track_rms_m,
            self.cross_track_max_m,
            output::counted(u64::from(self.departures), "departure"),
            output::counted(u64::from(self.collisions), "collision"),
            clearance.unwrap_or_default(),
            at_line.unwrap_or_default(),
        )
    }
}

impl Readable for DecisionState {
    fn readable(&self) -> String {
        format!(
            "{} since {}: {}; wants {:.2} m/s, steering {}, {}",
            self.state.name(),
            self.since,
            self.reason,
            self.target_speed_m_s,
            angle(self.steering_rad),
            output::counted(self.transitions, "transition"),
        )
    }
}

impl Readable for Health {
    fn readable(&self) -> String {
        let age = or_none(self.age_ms, |age| format!("{:.1} ms", age.p50));
        let step = time::span(self.step_us.p50 * 1e-6);
        let (node, operator, rate) = (&self.node, &self.operator, self.rate_hz);
        format!(
            "{node} ({operator}): {rate:.1} Hz, step {step}, age {age}, {}, {}",
            output::counted(self.overruns, "overrun"),
            output::counted(self.errors, "error")
        )
    }
}

impl Readable for McuPins {
    fn readable(&self) -> String {
        let servo = or_none(self.servo_us, |us| format!("{us} µs"));
        let motor = if self.brake { "brake".to_owned() } else { format!("duty {:+.3}", self.motor_duty) };
        format!("servo {servo}, motor {motor}")
    }
}

impl Readable for McuSensors {
    fn readable(&self) -> String {
        let period = or_none(self.encoder_period_us, |us| format!("{us} µs"));
        let button = if self.estop_pressed { "e-stop PRESSED" } else { "e-stop released" };
        format!("{} encoder ticks (period {period}), battery {:.2} V, {button}", self.encoder_ticks, self.battery_v)
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{DriveState, Encoding, Fault, FaultSet, Meta, Origins, Stamp, dynamic};

    use super::*;

    fn shown(message: &impl Message) -> String {
        let encoded = message.encode().expect("it encodes");
        of(&header(message_type(message), encoded.meta), &encoded.payload).expect("it decodes")
    }

    fn message_type<T: Message>(_: &T) -> MessageType {
        T::TYPE
    }

    fn header(message_type: MessageType, meta: Meta) -> Header {
        Header { epoch: 0, seq: 0, stamp: Stamp::ZERO, origins: Origins::none(), message_type, meta }
    }

    #[test]
    fn every_type_that_json_knows_has_a_text() {
        let texts: Vec<MessageType> = known().into_iter().map(|(known, _)| known).collect();
        let json: Vec<MessageType> = dynamic::types().into_iter().map(|known| known.message_type).collect();
        assert_eq!(texts, json, "add the new type to `known` here");
    }

    #[test]
    fn an_image_is_size_and_encoding() {
        let pixels = Payload::from(vec![0; 640 * 480 * 3]);
        let image = Image::packed(640, 480, Encoding::Bgr8, pixels).expect("the size fits");
        assert_eq!(shown(&image), "640x480 bgr8, 921600 B", "no pixels in the terminal");
    }

    #[test]
    fn angles_say_their_side() {
        let left = Command { steering_rad: 0.1, speed_m_s: 0.5 };
        assert_eq!(shown(&left), "steering 5.7° left, speed 0.50 m/s", "+ is left");
        let right = Command { steering_rad: -0.1, speed_m_s: -0.2 };
        assert_eq!(shown(&right), "steering 5.7° right, speed -0.20 m/s", "- is right");
        assert_eq!(shown(&Command::default()), "steering 0.0°, speed 0.00 m/s", "straight ahead has no side");
    }

    #[test]
    fn a_scan_names_its_nearest_return() {
        let ranges_m = vec![f32::INFINITY, 2.5, f32::NAN, 1.25];
        let (range_min_m, range_max_m) = (0.1, 16.0);
        let scan = LaserScan {
            angle_min_rad: 0.0,
            angle_increment_rad: 0.5,
            scan_time_s: 0.1,
            range_min_m,
            range_max_m,
            ranges_m,
        };
        let expected = "4 points from 0.0° to 85.9°, nearest 1.25 m at 85.9° left, 1 free, 1 without measurement";
        assert_eq!(shown(&scan), expected, "inf and NaN are told apart");
    }

    #[test]
    fn no_lane_and_no_return_are_words() {
        let none = LaneEstimate { lane: None, quality: 0.0, threshold: Some(190) };
        assert_eq!(shown(&none), "no lane, threshold 190", "no lane");
        let sector = Sector {
            name: "front".into(),
            from_rad: -0.3,
            to_rad: 0.3,
            nearest_m: None,
            nearest_bearing_rad: None,
            returns_within: 0,
            occupied: false,
            coverage: 1.0,
        };
        let expected = "front  free      no return, 0 returns within the limit, 100 % seen";
        assert_eq!(shown(&Sectors { sectors: vec![sector] }), expected, "no return");
    }

    #[test]
    fn a_fault_says_what_to_do() {
        let telemetry = WheelTelemetry {
            ticks: 9,
            tick_period_us: None,
            speed_m_s: 0.0,
            steering_rad: 0.0,
            battery_v: Some(7.4),
            faults: FaultSet::NONE.with(Fault::BatteryLow),
            driving: false,
            last_command_seq: None,
            round_trip_us: None,
            frames_lost: 3,
            frames_damaged: 1,
        };
        assert!(shown(&telemetry).contains("3 frames lost, 1 damaged"), "the line: {}", shown(&telemetry));
        assert!(shown(&telemetry).ends_with("FAULT: the battery is too low to drive; charge it"), "the fault's text");
    }

    #[test]
    fn a_decision_says_why() {
        let state = DecisionState {
            state: DriveState::ObstacleStop,
            since: Stamp::from_nanos(1_500_000_000),
            reason: "front at 0.42 m".into(),
            target_speed_m_s: 0.0,
            steering_rad: 0.0,
            transitions: 3,
        };
        let expected =
            "obstacle-stop since 1.500000000 s: front at 0.42 m; wants 0.00 m/s, steering 0.0°, 3 transitions";
        assert_eq!(shown(&state), expected, "state, reason, numbers");
    }

    #[test]
    fn foreign_types_and_old_versions_are_named() {
        let own = header(MessageType::new("acme/Radar", 3), Meta::new());
        let text = of(&own, &Payload::from(vec![0; 12])).expect("a foreign type is no error");
        assert_eq!(text, "12 B of `acme/Radar v3`, a type of your own", "name and size");
        let old = header(MessageType::new("carril/Command", 0), Meta::new());
        assert!(of(&old, &Payload::default()).is_err(), "an old version is refused");
    }
}
