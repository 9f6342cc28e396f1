//! The conversation in rosserial: which topics the device has, by its own account; time for those who ask; texts; and what is
//! said on each topic. The device tells its topics only when it is asked, so it is asked again after anything that may have
//! made it forget.

use std::collections::BTreeMap;
use std::time::Duration;

use carril_messages::Stamp;

use super::config::{StockConfig, TickMeaning};
use super::ros_messages::{MessageKind, TopicInfo, read_f32, read_log, read_twist_x, read_u16};
use super::rosserial::{Decoder, Packet, encode, system};
use super::talk::{Heard, Order};
use super::types::StockNote;
use super::units;

/// An answer to the question for topics comes within this time. Topics that come later were not asked for.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);
/// Between two questions because of a topic that nobody has told of.
const ASK_AGAIN_AFTER: Duration = Duration::from_secs(1);
/// No battery of such a car has more, V. More is a damaged number.
const HIGHEST_V: f32 = 100.0;
/// Topics of one device that are kept. A small chip has 25 each way at most.
const MAX_TOPICS: usize = 64;

/// Which way the messages of a topic go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    ToDevice,
    FromDevice,
}

/// What a topic is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Use {
    Speed,
    Steering,
    Twist,
    Ticks,
    Voltage,
    /// Known, and there is no place for it.
    None,
}

/// The topics that are known, and the types that each may have.
const KNOWN: [(Way, &str, Use, &[MessageKind]); 10] = [
    (Way::ToDevice, "speed", Use::Speed, &[MessageKind::Int16]),
    (Way::ToDevice, "steering", Use::Steering, &[MessageKind::Float32, MessageKind::UInt8]),
    (Way::ToDevice, "led", Use::None, &[MessageKind::String]),
    (Way::FromDevice, "twist", Use::Twist, &[MessageKind::Twist]),
    (Way::FromDevice, "ticks", Use::Ticks, &[MessageKind::UInt16]),
    (Way::FromDevice, "voltage", Use::Voltage, &[MessageKind::Float32]),
    (Way::FromDevice, "yaw", Use::None, &[MessageKind::Float32]),
    (Way::FromDevice, "pitch", Use::None, &[MessageKind::Float32]),
    (Way::FromDevice, "roll", Use::None, &[MessageKind::Float32]),
    (Way::FromDevice, "steering_angle", Use::None, &[MessageKind::UInt16]),
];

/// A topic that the device has.
#[derive(Clone, Debug, PartialEq)]
struct Topic {
    way: Way,
    purpose: Use,
    kind: Option<MessageKind>,
    info: TopicInfo,
}

#[derive(Default)]
pub(super) struct RosserialTalk {
    decoder: Decoder,
    topics: BTreeMap<u16, Topic>,
    /// Where the speed went before the device was asked anew: enough to stop it.
    former_speed: Option<u16>,
    asked: Option<Stamp>,
    implausible: u64,
}

impl RosserialTalk {
    pub fn restart(&mut self) {
        self.former_speed = self.id_of(Use::Speed).or(self.former_speed);
        self.decoder.restart();
        self.topics.clear();
    }

    pub fn ask(&mut self, now: Stamp, wire: &mut Vec<u8>) {
        self.asked = Some(now);
        encode(system::PUBLISHER, &[], wire);
    }

    pub fn is_ready(&self) -> bool {
        self.id_of(Use::Speed).is_some() && self.id_of(Use::Steering).is_some()
    }

    pub fn missing(&self) -> Option<String> {
        let missing = |purpose, name| self.id_of(purpose).is_none().then_some(name);
        let names: Vec<&str> =
            [missing(Use::Speed, "`speed`"), missing(Use::Steering, "`steering`")].into_iter().flatten().collect();
        let told = !self.topics.is_empty();
        (told && !names.is_empty()).then(|| {
            format!("the device subscribes no {}, so it cannot be driven; check its firmware", names.join(" and no "))
        })
    }

    pub fn summary(&self) -> String {
        let list = |way| {
            let topics = self.topics.values().filter(|topic| topic.way == way);
            let names: Vec<String> =
                topics.map(|topic| format!("{} ({})", topic.info.name, topic.info.message_type)).collect();
            if names.is_empty() { "nothing".to_owned() } else { names.join(", ") }
        };
        format!("it takes {}, and tells {}", list(Way::ToDevice), list(Way::FromDevice))
    }

    /// Whether it tells anything without being asked, besides the time requests every few seconds.
    pub fn is_talkative(&self) -> bool {
        self.topics.values().any(|topic| topic.way == Way::FromDevice)
    }

    pub fn usual_ticks(&self) -> TickMeaning {
        match self.steering() {
            Some((_, MessageKind::Float32)) => TickMeaning::Counter,
            _ => TickMeaning::SinceLast,
        }
    }

    pub fn damaged(&self) -> u64 {
        self.decoder.damage().packets() + self.implausible
    }

    pub fn encode(&self, order: Order, config: &StockConfig, wire: &mut Vec<u8>) {
        if let Some(id) = self.id_of(Use::Speed).or(self.former_speed) {
            encode(id, &order.power.to_le_bytes(), wire);
        }
        if let (Some(steering_rad), Some((id, kind))) = (order.steering_rad, self.steering()) {
            match kind {
                MessageKind::Float32 => encode(id, &units::degrees_of_rad(steering_rad, config).to_le_bytes(), wire),
                _ => encode(id, &[units::servo_of_rad(steering_rad, config)], wire),
            }
        }
    }

    pub fn receive(&mut self, arrived: Stamp, bytes: &[u8], heard: &mut Vec<Heard>, wire: &mut Vec<u8>) {
        let mut packets = Vec::new();
        self.decoder.receive(bytes, &mut packets);
        for packet in packets {
            self.hear(&packet, arrived, heard, wire);
        }
    }

    fn hear(&mut self, packet: &Packet, arrived: Stamp, heard: &mut Vec<Heard>, wire: &mut Vec<u8>) {
        let understood = match packet.topic {
            system::PUBLISHER => self.hear_topic(Way::FromDevice, &packet.payload, arrived, heard),
            system::SUBSCRIBER => self.hear_topic(Way::ToDevice, &packet.payload, arrived, heard),
            system::LOG => read_log(&packet.payload).map(|(level, text)| heard.push(Heard::Log(level, text))),
            system::TIME => {
                self.tell_time(arrived, heard, wire);
                Some(())
            }
            own if own >= system::FIRST_OWN => self.hear_message(packet, arrived, heard, wire),
            // Services and parameters: such cars have none.
            _ => Some(()),
        };
        self.implausible += u64::from(understood.is_none());
    }

    fn tell_time(&self, now: Stamp, heard: &mut Vec<Heard>, wire: &mut Vec<u8>) {
        let nanos = now.as_nanos().max(0);
        let (seconds, rest) = (nanos / 1_000_000_000, nanos % 1_000_000_000);
        encode(system::TIME, &[(seconds as u32).to_le_bytes(), (rest as u32).to_le_bytes()].concat(), wire);
        if !self.is_talkative() {
            heard.push(Heard::Alive);
        }
    }

    fn hear_message(
        &mut self,
        packet: &Packet,
        arrived: Stamp,
        heard: &mut Vec<Heard>,
        wire: &mut Vec<u8>,
    ) -> Option<()> {
        let Some(topic) = self.topics.get(&packet.topic).filter(|topic| topic.way == Way::FromDevice) else {
            self.ask_again(arrived, wire);
            return None;
        };
        let report_with = if self.id_of(Use::Ticks).is_some() { Use::Ticks } else { Use::Twist };
        match topic.purpose {
            Use::Twist => heard.push(Heard::WheelFigure(read_twist_x(&packet.payload)?)),
            Use::Ticks => heard.push(Heard::Ticks { value: read_u16(&packet.payload)?, bits: 16 }),
            Use::Voltage => {
                let volts = read_f32(&packet.payload).filter(|volts| (0.0..=HIGHEST_V).contains(volts))?;
                heard.push(Heard::Battery(volts));
            }
            Use::Speed | Use::Steering | Use::None => {}
        }
        if topic.purpose == report_with {
            heard.push(Heard::Report);
        }
        heard.push(Heard::Alive);
        Some(())
    }

    /// A message on a topic that nobody has told of: what told of it was lost on the line.
    fn ask_again(&mut self, now: Stamp, wire: &mut Vec<u8>) {
        if self.asked.is_none_or(|asked| now.since(asked).to_duration() >= ASK_AGAIN_AFTER) {
            self.ask(now, wire);
        }
    }

    fn hear_topic(&mut self, way: Way, payload: &[u8], arrived: Stamp, heard: &mut Vec<Heard>) -> Option<()> {
        let info = TopicInfo::read(payload)?;
        let asked = self.asked.is_some_and(|asked| arrived.since(asked).to_duration() < ANSWER_WITHIN);
        if !asked {
            heard.push(Heard::Restarted);
            return Some(());
        }
        match check(way, &info) {
            Ok((purpose, kind)) => self.keep(Topic { way, purpose, kind, info }, heard),
            Err(problem) => {
                self.topics.retain(|_, topic| (topic.way, &topic.info.name) != (way, &info.name));
                self.refuse(way, info, &problem, heard);
            }
        }
        Some(())
    }

    /// Puts a topic in the place of one with the same number, or with the same purpose.
    fn keep(&mut self, topic: Topic, heard: &mut Vec<Heard>) {
        let purpose = topic.purpose;
        if self.topics.get(&topic.info.id).is_some_and(|known| known.is_needed() && known.purpose != purpose) {
            heard.push(Heard::Refused(format!(
                "the device gives number {} to `{}` and to another topic; check its firmware",
                topic.info.id, topic.info.name
            )));
            self.topics.remove(&topic.info.id);
            return;
        }
        if purpose != Use::None {
            self.topics.retain(|_, known| known.purpose != purpose);
        }
        if self.topics.len() < MAX_TOPICS || topic.is_needed() {
            self.topics.insert(topic.info.id, topic);
        }
    }

    fn refuse(&mut self, way: Way, info: TopicInfo, problem: &str, heard: &mut Vec<Heard>) {
        if way == Way::ToDevice && matches!(info.name.as_str(), "speed" | "steering") {
            heard.push(Heard::Refused(format!("{problem}; flash firmware that has one of these, or carril's own")));
            return;
        }
        heard.push(Heard::Note(StockNote::TopicRefused(format!("{problem}; it is not used"))));
        // It is known of all the same: its messages are no reason to ask again.
        self.keep(Topic { way, purpose: Use::None, kind: None, info }, heard);
    }

    fn id_of(&self, purpose: Use) -> Option<u16> {
        self.topics.values().find(|topic| topic.purpose == purpose).map(|topic| topic.info.id)
    }

    fn steering(&self) -> Option<(u16, MessageKind)> {
        let topic = self.topics.values().find(|topic| topic.purpose == Use::Steering)?;
        Some((topic.info.id, topic.kind?))
    }
}

impl Topic {
    fn is_needed(&self) -> bool {
        matches!(self.purpose, Use::Speed | Use::Steering)
    }
}

/// What a topic is for, and its type. `Err`: what was got and what is allowed.
fn check(way: Way, info: &TopicInfo) -> Result<(Use, Option<MessageKind>), String> {
    let TopicInfo { id, name, message_type, md5, buffer_bytes } = info;
    let does = if way == Way::ToDevice { "subscribes" } else { "publishes" };
    if *id < system::FIRST_OWN {
        let first = system::FIRST_OWN;
        return Err(format!("the device {does} `{name}` as topic {id}, allowed is {first} and more"));
    }
    let Some((_, _, purpose, kinds)) = KNOWN.iter().find(|(known_way, known, ..)| (*known_way, *known) == (way, name))
    else {
        return Ok((Use::None, None));
    };
    let Some(kind) = kinds.iter().find(|kind| (kind.name(), kind.md5()) == (message_type, md5)) else {
        let allowed: Vec<String> = kinds.iter().map(MessageKind::to_string).collect();
        let allowed = allowed.join(" or ");
        return Err(format!("the device {does} `{name}` as {message_type} (md5 {md5}), allowed is {allowed}"));
    };
    let needed = kind.fixed_bytes();
    if way == Way::ToDevice && *buffer_bytes < needed {
        return Err(format!("the device has a buffer of {buffer_bytes} bytes for `{name}`, needed are {needed}"));
    }
    Ok((*purpose, Some(*kind)))
}
