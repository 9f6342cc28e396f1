//! Cars with stock firmware, as their descriptions have them: rosserial's protocol page and client library, and the firmware of
//! AutoModelCar v3 and v4. They share no code with the bridge: what it gets wrong, they do not get wrong with it.
#![allow(dead_code, reason = "each test program uses a part of it")]

/// Time between two rounds of reports, µs.
const ROUND_US: u64 = 10_000;
/// From reset to the first word, µs: boot loader and sensors.
const BOOT_US: u64 = 1_500_000;
/// A wheel turns so fast at full power, rad/s.
const FULL_RAD_S: f64 = 60.0;

/// A car at the other end of the line.
pub trait Car {
    /// Bytes that have arrived.
    fn receive(&mut self, now_us: u64, bytes: &[u8]);
    /// Lets time pass; what it sends.
    fn step(&mut self, now_us: u64) -> Vec<u8>;
    /// What the motor does, -1020 to 1020.
    fn power(&self) -> i16;
    /// Another power than it was told, as after damage on the line, which has no good checksum.
    fn set_power(&mut self, power: i16);
    /// Where the wheels point, -1 (right stop) to 1 (left stop). `None` before the first command.
    fn steering(&self) -> Option<f64>;
    /// Reset button, watchdog, or somebody has opened the port.
    fn reset(&mut self, now_us: u64);
    /// Orders for the motor so far.
    fn orders(&self) -> usize;
    /// What it got that its firmware would not understand, or worse.
    fn complaints(&self) -> &[String];
    /// Ticks that it has reported, all in all.
    fn ticks_told(&self) -> u32;
}

/// A topic of a rosserial car.
#[derive(Clone, Debug)]
pub struct Topic {
    pub id: u16,
    pub subscribes: bool,
    pub name: &'static str,
    pub kind: &'static str,
    pub md5: &'static str,
    pub buffer: i32,
}

pub const FLOAT32: (&str, &str) = ("std_msgs/Float32", "73fcbf46b49191e672908e50842a83d4");
pub const UINT8: (&str, &str) = ("std_msgs/UInt8", "7c8164229e7d2c17eb95e9231617fdee");
pub const INT16: (&str, &str) = ("std_msgs/Int16", "8524586e34fbd7cb1c08c5f5f1ca0e57");
pub const UINT16: (&str, &str) = ("std_msgs/UInt16", "1df79edf208b629fe6b81923a544552d");
pub const STRING: (&str, &str) = ("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1");
pub const TWIST: (&str, &str) = ("geometry_msgs/Twist", "9f195f881246fdfa2798d1d3eebca84a");

/// A topic that the device publishes: numbers from 125 on.
pub fn publishes(number: u16, name: &'static str, (kind, md5): (&'static str, &'static str)) -> Topic {
    Topic { id: 125 + number, subscribes: false, name, kind, md5, buffer: 280 }
}

/// A topic that the device subscribes: numbers from 100 on.
pub fn subscribes(number: u16, name: &'static str, (kind, md5): (&'static str, &'static str)) -> Topic {
    Topic { id: 100 + number, subscribes: true, name, kind, md5, buffer: 280 }
}

/// A car that speaks rosserial.
pub struct RosserialCar {
    pub topics: Vec<Topic>,
    /// Ticks are those since the last report.
    ticks_since_last: bool,
    configured: bool,
    boot_until_us: u64,
    incoming: Vec<u8>,
    last_byte_us: u64,
    outgoing: Vec<u8>,
    next_round_us: u64,
    next_time_request_us: u64,
    time_heard_us: u64,
    power: i16,
    steering: Option<f64>,
    travelled: f64,
    ticks: u16,
    ticks_told: u32,
    orders: usize,
    complaints: Vec<String>,
    /// The time that the host has told last.
    pub clock: Option<(u32, u32)>,
    /// Said in the next round.
    pub texts: Vec<(u8, &'static str)>,
}

pub fn sum(bytes: &[u8]) -> u8 {
    (255 - bytes.iter().map(|byte| u32::from(*byte)).sum::<u32>() % 256) as u8
}

/// A packet of rosserial.
pub fn packet(topic: u16, payload: &[u8]) -> Vec<u8> {
    let len = (payload.len() as u16).to_le_bytes();
    let body = [&topic.to_le_bytes()[..], payload].concat();
    [&[0xFF, 0xFE][..], &len, &[sum(&len)], &body, &[sum(&body)]].concat()
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

impl Topic {
    pub fn packet(&self) -> Vec<u8> {
        let Self { id, name, kind, md5, buffer, .. } = self;
        let strings = [text(name), text(kind), text(md5)].concat();
        let payload = [&id.to_le_bytes()[..], &strings, &buffer.to_le_bytes()].concat();
        packet(u16::from(self.subscribes), &payload)
    }
}

impl RosserialCar {
    /// The 1:10 car: steering in degrees to the right.
    pub fn one_tenth() -> Self {
        Self::new(
            vec![
                publishes(0, "twist", TWIST),
                publishes(1, "ticks", UINT16),
                subscribes(0, "steering", FLOAT32),
                subscribes(1, "speed", INT16),
            ],
            false,
        )
    }

    /// AutoModelCar v3: steering from 0 to 180.
    pub fn v3() -> Self {
        let published = [("twist", TWIST), ("yaw", FLOAT32), ("pitch", FLOAT32), ("roll", FLOAT32)];
        let more = [("steering_angle", UINT16), ("ticks", UINT16)];
        let published = published.into_iter().chain(more).zip(0..).map(|((name, kind), at)| publishes(at, name, kind));
        let subscribed = [("led", STRING), ("steering", UINT8), ("speed", INT16)];
        let subscribed = subscribed.into_iter().zip(0..).map(|((name, kind), at)| subscribes(at, name, kind));
        Self::new(published.chain(subscribed).collect(), true)
    }

    pub fn new(topics: Vec<Topic>, ticks_since_last: bool) -> Self {
        Self {
            topics,
            ticks_since_last,
            configured: false,
            boot_until_us: 0,
            incoming: Vec::new(),
            last_byte_us: 0,
            outgoing: Vec::new(),
            next_round_us: 0,
            next_time_request_us: 0,
            time_heard_us: 0,
            power: 0,
            steering: None,
            travelled: 0.0,
            ticks: 0,
            ticks_told: 0,
            orders: 0,
            complaints: Vec::new(),
            clock: None,
            texts: Vec::new(),
        }
    }

    fn take_packets(&mut self, now_us: u64) {
        // As the library does it: in order, forgetting what does not fit.
        loop {
            let Some(start) = self.incoming.windows(2).position(|pair| pair == [0xFF, 0xFE]) else { return };
            self.incoming.drain(..start);
            let Some(header) = self.incoming.get(..7) else { return };
            let len = usize::from(u16::from_le_bytes([header[2], header[3]]));
            if sum(&header[2..4]) != header[4] || len > 280 {
                self.incoming.drain(..2);
                continue;
            }
            let Some(whole) = self.incoming.get(..8 + len) else { return };
            let (body, check) = (whole[5..7 + len].to_vec(), whole[7 + len]);
            self.incoming.drain(..8 + len);
            if sum(&body) == check {
                self.obey(u16::from_le_bytes([body[0], body[1]]), &body[2..], now_us);
            }
        }
    }

    fn obey(&mut self, topic: u16, payload: &[u8], now_us: u64) {
        let known = self.topics.iter().find(|known| known.subscribes && known.id == topic).cloned();
        match (topic, known.as_ref().map(|topic| (topic.name, topic.kind))) {
            (0, _) => self.negotiate(now_us),
            (10, _) => {
                let number = |at: usize| u32::from_le_bytes(payload[at..at + 4].try_into().expect("four bytes"));
                self.clock = Some((number(0), number(4)));
                self.time_heard_us = now_us;
            }
            (_, Some(("speed", _))) => self.drive(payload),
            (_, Some(("steering", "std_msgs/Float32"))) => {
                let degrees = f32::from_le_bytes(payload.try_into().expect("four bytes"));
                if !(-20.0..=20.0).contains(&degrees) {
                    self.complaints.push(format!("{degrees} degrees"));
                }
                self.steering = Some(f64::from(-degrees / 20.0));
            }
            (_, Some(("steering", _))) => {
                if payload.len() != 1 || payload[0] > 180 {
                    self.complaints.push(format!("steering {payload:?}"));
                }
                self.steering = Some((f64::from(payload[0]) - 90.0) / 90.0);
            }
            _ => self.complaints.push(format!("topic {topic} with {payload:?}")),
        }
    }

    fn drive(&mut self, payload: &[u8]) {
        let power = i16::from_le_bytes(payload.try_into().expect("two bytes"));
        if !(-1020..=1020).contains(&power) {
            self.complaints.push(format!("power {power}"));
        }
        self.power = power;
        self.orders += 1;
    }

    fn negotiate(&mut self, now_us: u64) {
        self.outgoing.extend(packet(10, &[0; 8]));
        for topic in self.topics.iter().filter(|topic| !topic.subscribes) {
            self.outgoing.extend(topic.packet());
        }
        for topic in self.topics.iter().filter(|topic| topic.subscribes) {
            self.outgoing.extend(topic.packet());
        }
        self.configured = true;
        self.time_heard_us = now_us;
        self.next_time_request_us = now_us + 2_500_000;
    }

    fn publish(&mut self, name: &str, payload: &[u8]) {
        if let Some(topic) = self.topics.iter().find(|topic| !topic.subscribes && topic.name == name) {
            self.outgoing.extend(packet(topic.id, payload));
        }
    }

    fn report(&mut self) {
        let rad_s = f64::from(self.power) / 1020.0 * FULL_RAD_S;
        let new = count(&mut self.travelled, rad_s);
        let twist: Vec<u8> = [rad_s, 0.0, 0.0, 0.0, 0.0, 0.0].into_iter().flat_map(f64::to_le_bytes).collect();
        self.publish("twist", &twist);
        for name in ["yaw", "pitch", "roll"] {
            self.publish(name, &0.25_f32.to_le_bytes());
        }
        self.publish("steering_angle", &345_u16.to_le_bytes());
        self.ticks = if self.ticks_since_last { new } else { self.ticks.wrapping_add(new) };
        let ticks = self.ticks.to_le_bytes();
        self.publish("ticks", &ticks);
        self.ticks_told += u32::from(new);
    }
}

/// New ticks of a wheel with 120 of them, after a round.
fn count(travelled: &mut f64, rad_s: f64) -> u16 {
    let ticks = |angle: f64| (angle / std::f64::consts::TAU * 120.0).floor();
    let before = ticks(*travelled);
    *travelled += rad_s.abs() * ROUND_US as f64 * 1e-6;
    (ticks(*travelled) - before) as u16
}

impl Car for RosserialCar {
    fn receive(&mut self, now_us: u64, bytes: &[u8]) {
        if now_us < self.boot_until_us {
            return;
        }
        // A packet must arrive within 20 ms.
        if now_us > self.last_byte_us + 20_000 {
            self.incoming.clear();
        }
        self.last_byte_us = now_us;
        self.incoming.extend(bytes);
        self.take_packets(now_us);
    }

    fn step(&mut self, now_us: u64) -> Vec<u8> {
        if now_us < self.boot_until_us {
            return Vec::new();
        }
        if now_us > self.time_heard_us + 11_000_000 {
            self.configured = false;
        }
        for (level, words) in std::mem::take(&mut self.texts) {
            let payload = [&[level][..], &text(words)].concat();
            self.outgoing.extend(packet(7, &payload));
        }
        if self.configured && now_us >= self.next_time_request_us {
            self.next_time_request_us = now_us + 2_500_000;
            self.outgoing.extend(packet(10, &[0; 8]));
        }
        if now_us >= self.next_round_us {
            self.next_round_us = now_us + ROUND_US;
            if self.configured {
                self.report();
            }
        }
        std::mem::take(&mut self.outgoing)
    }

    fn power(&self) -> i16 {
        self.power
    }

    fn set_power(&mut self, power: i16) {
        self.power = power;
    }

    fn steering(&self) -> Option<f64> {
        self.steering
    }

    fn reset(&mut self, now_us: u64) {
        let (topics, told) = (std::mem::take(&mut self.topics), self.ticks_told);
        let (orders, complaints) = (self.orders, std::mem::take(&mut self.complaints));
        *self = Self { orders, complaints, ticks_told: told, ..Self::new(topics, self.ticks_since_last) };
        self.boot_until_us = now_us + BOOT_US;
        self.texts.push((1, "Testing device connections..."));
    }

    fn orders(&self) -> usize {
        self.orders
    }

    fn complaints(&self) -> &[String] {
        &self.complaints
    }

    fn ticks_told(&self) -> u32 {
        self.ticks_told
    }
}

/// AutoModelCar v4.
#[derive(Default)]
pub struct PacketCar {
    boot_until_us: u64,
    incoming: Vec<u8>,
    next_round_us: u64,
    power: i16,
    steering: Option<f64>,
    travelled: f64,
    ticks_told: u32,
    orders: usize,
    complaints: Vec<String>,
    /// Said in the next round.
    pub texts: Vec<(u8, &'static str)>,
    /// Speaks as AutoMiny does since 2019.
    pub autominy: bool,
}

/// COBS, and the zero that ends a frame.
pub fn stuffed(raw: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    for run in raw.split(|byte| *byte == 0) {
        assert!(run.len() < 254, "longer runs do not occur here");
        out.push(run.len() as u8 + 1);
        out.extend(run);
    }
    out.push(0);
    out
}

/// `None`: the stuffing does not come out even.
pub fn unstuffed(mut bytes: &[u8]) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    while let [code, rest @ ..] = bytes {
        let (run, after) = rest.split_at_checked(usize::from(*code).checked_sub(1)?)?;
        out.extend(run);
        if !after.is_empty() && *code != 255 {
            out.push(0);
        }
        bytes = after;
    }
    Some(out)
}

impl PacketCar {
    fn obey(&mut self, raw: &[u8]) {
        match raw {
            [4, low, high] => {
                self.power = i16::from_le_bytes([*low, *high]);
                self.orders += 1;
                if !(-1020..=1020).contains(&self.power) {
                    self.complaints.push(format!("power {}", self.power));
                }
            }
            [5, servo @ 0..=180] => self.steering = Some((f64::from(*servo) - 90.0) / 90.0),
            other => self.complaints.push(format!("frame {other:?}")),
        }
    }
}

impl Car for PacketCar {
    fn receive(&mut self, now_us: u64, bytes: &[u8]) {
        if now_us < self.boot_until_us {
            return;
        }
        for byte in bytes {
            if *byte != 0 {
                self.incoming.push(*byte);
                continue;
            }
            match unstuffed(&std::mem::take(&mut self.incoming)) {
                // The library calls the handler all the same, which reads a type that is not there.
                Some(raw) if raw.is_empty() => self.complaints.push("an empty frame".into()),
                Some(raw) => self.obey(&raw),
                None => self.complaints.push("stuffing".into()),
            }
        }
    }

    fn step(&mut self, now_us: u64) -> Vec<u8> {
        if now_us < self.boot_until_us || now_us < self.next_round_us {
            return Vec::new();
        }
        self.next_round_us = now_us + ROUND_US;
        let rad_s = f64::from(self.power) / 1020.0 * FULL_RAD_S;
        let ticks = count(&mut self.travelled, rad_s) as u8;
        self.ticks_told += u32::from(ticks);
        let floats = |kind: u8, values: &[f32]| {
            let fields: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            stuffed(&[&[kind][..], &fields].concat())
        };
        let mut out = Vec::new();
        for (level, words) in std::mem::take(&mut self.texts) {
            out.extend(stuffed(&[&[level][..], words.as_bytes(), &[0]].concat()));
        }
        if self.autominy {
            out.extend(stuffed(&[&[9][..], &[7; 22]].concat()));
            out.extend(floats(10, &[14.8]));
        } else {
            out.extend(floats(10, &[1.0, -0.5, 0.25]));
            out.extend(floats(9, &[rad_s as f32]));
            out.extend(floats(11, &[14.8]));
        }
        out.extend(stuffed(&[8, ticks]));
        out.extend(stuffed(&[7, 0x59, 0x01]));
        out
    }

    fn power(&self) -> i16 {
        self.power
    }

    fn set_power(&mut self, power: i16) {
        self.power = power;
    }

    fn steering(&self) -> Option<f64> {
        self.steering
    }

    fn reset(&mut self, now_us: u64) {
        let complaints = std::mem::take(&mut self.complaints);
        let (orders, ticks_told, autominy) = (self.orders, self.ticks_told, self.autominy);
        *self = Self { ticks_told, orders, complaints, autominy, ..Self::default() };
        self.boot_until_us = now_us + BOOT_US;
        self.texts.push((1, "Testing device connections..."));
    }

    fn orders(&self) -> usize {
        self.orders
    }

    fn complaints(&self) -> &[String] {
        &self.complaints
    }

    fn ticks_told(&self) -> u32 {
        self.ticks_told
    }
}
