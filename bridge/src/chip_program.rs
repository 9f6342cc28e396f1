//! A program that plays the chip, driven over its standard input and output in the chip's own time: the unchanged firmware in simavr
//! (`bridge/firmware/simulator`), or its core alone (`bridge/firmware/host`). Both speak the same; this is the other side of it.

use std::io::{self, BufReader, BufWriter, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

/// Cycles of the chip per µs.
pub const CYCLES_PER_US: u64 = 16;
/// Bytes of the chip's EEPROM.
pub const EEPROM_BYTES: usize = 1024;
/// No reply has more events: 2 ms of chip time bring some hundreds.
const MAX_EVENTS: u32 = 1 << 22;

/// What the world does to the chip while it runs on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChipInputs {
    /// Edges of the encoder per second; negative: backwards, which only a second channel tells.
    pub encoder_edges_per_s: f32,
    /// At the battery, mV.
    pub battery_mv: u16,
    /// The e-stop button is pressed.
    pub estop_pressed: bool,
}

impl Default for ChipInputs {
    /// A full battery, and a wheel that stands.
    fn default() -> Self {
        Self { encoder_edges_per_s: 0.0, battery_mv: 8_000, estop_pressed: false }
    }
}

/// What the chip did, and when: cycles since it was built.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChipEvent {
    /// When.
    pub cycles: u64,
    /// What.
    pub what: Happened,
}

/// What a chip does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Happened {
    /// A byte is on the line, to its end.
    Sent(u8),
    /// The motor's duty, 0 to 255.
    MotorDuty(u8),
    /// Level of the motor's direction pin.
    Direction(bool),
    /// Level of the motor driver's reset pin.
    ResetPin(bool),
    /// A servo pulse has ended: its width, cycles.
    ServoPulse(u32),
    /// The UART lost a byte: the chip was too slow.
    ReceivedByteLost,
    /// The watchdog has started the chip anew.
    WatchdogReset,
    /// It does nothing any more.
    Crashed,
    /// The longest pass of the main loop, cycles.
    LongestPass(u32),
    /// Something that this side does not know.
    Unknown(u8),
}

/// A stretch of the chip's time.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Stretch {
    /// Its end, cycles since the chip was built.
    pub end_cycles: u64,
    /// Edges of the encoder since the chip was built.
    pub edges: u32,
    /// What the chip did, in order.
    pub events: Vec<ChipEvent>,
}

impl Stretch {
    /// What it sent.
    pub fn sent(&self) -> Vec<u8> {
        let byte = |event: &ChipEvent| match event.what {
            Happened::Sent(byte) => Some(byte),
            _ => None,
        };
        self.events.iter().filter_map(byte).collect()
    }
}

/// The program. It ends when this is dropped.
pub struct ChipProgram {
    child: Child,
    requests: Option<BufWriter<ChildStdin>>,
    replies: BufReader<ChildStdout>,
}

impl ChipProgram {
    /// Starts it. `elf`: the firmware; `None`: it is built in.
    pub fn start(program: &Path, elf: Option<&Path>) -> io::Result<Self> {
        let mut command = Command::new(program);
        if let Some(elf) = elf {
            command.arg("--elf").arg(elf);
        }
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let pipes = child.stdin.take().zip(child.stdout.take());
        let (requests, replies) = pipes.ok_or_else(|| io::Error::other("the program has no pipes"))?;
        Ok(Self { child, requests: Some(BufWriter::new(requests)), replies: BufReader::new(replies) })
    }

    /// The chip runs for so long, while `bytes` come in on its line.
    pub fn advance(&mut self, micros: u32, inputs: ChipInputs, bytes: &[u8]) -> io::Result<Stretch> {
        let len = u16::try_from(bytes.len()).map_err(|_| io::Error::other("more than 65535 bytes at once"))?;
        let mut request = vec![b'A'];
        request.extend(micros.to_le_bytes());
        request.extend(inputs.encoder_edges_per_s.to_le_bytes());
        request.extend(inputs.battery_mv.to_le_bytes());
        request.push(u8::from(inputs.estop_pressed));
        request.extend(len.to_le_bytes());
        request.extend(bytes);
        self.ask(&request, b'a')?;
        let end_cycles = u64::from_le_bytes(self.read()?);
        let edges = u32::from_le_bytes(self.read()?);
        let count = u32::from_le_bytes(self.read()?);
        if count > MAX_EVENTS {
            return Err(io::Error::other(format!("{count} events in one reply")));
        }
        let events = (0..count).map(|_| self.event()).collect::<io::Result<_>>()?;
        Ok(Stretch { end_cycles, edges, events })
    }

    /// Off and on again. The EEPROM stays.
    pub fn power_cycle(&mut self) -> io::Result<()> {
        self.ask(b"P", b'p')
    }

    /// The program of the chip hangs, with its interrupts off.
    pub fn hang(&mut self) -> io::Result<()> {
        self.ask(b"J", b'j')
    }

    /// What the EEPROM holds.
    pub fn eeprom(&mut self) -> io::Result<[u8; EEPROM_BYTES]> {
        self.ask(b"E", b'e')?;
        self.read()
    }

    /// Writes the EEPROM from outside.
    pub fn set_eeprom(&mut self, bytes: &[u8; EEPROM_BYTES]) -> io::Result<()> {
        self.ask(&[&b"W"[..], bytes].concat(), b'w')
    }

    fn ask(&mut self, request: &[u8], expected: u8) -> io::Result<()> {
        let requests = self.requests.as_mut().ok_or(io::ErrorKind::BrokenPipe)?;
        requests.write_all(request)?;
        requests.flush()?;
        match self.read::<1>()? {
            [got] if got == expected => Ok(()),
            [got] => Err(io::Error::other(format!("the program answers {got:#04x}, expected {expected:#04x}"))),
        }
    }

    fn read<const N: usize>(&mut self) -> io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.replies.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    fn event(&mut self) -> io::Result<ChipEvent> {
        let cycles = u64::from_le_bytes(self.read()?);
        let [kind] = self.read()?;
        let value = u32::from_le_bytes(self.read()?);
        let what = match kind {
            1 => Happened::Sent(value as u8),
            2 => Happened::MotorDuty(value.min(255) as u8),
            3 => Happened::Direction(value != 0),
            4 => Happened::ResetPin(value != 0),
            5 => Happened::ServoPulse(value),
            6 => Happened::ReceivedByteLost,
            7 => Happened::WatchdogReset,
            8 => Happened::Crashed,
            9 => Happened::LongestPass(value),
            other => Happened::Unknown(other),
        };
        Ok(ChipEvent { cycles, what })
    }
}

impl Drop for ChipProgram {
    fn drop(&mut self) {
        // The end of its input ends it.
        drop(self.requests.take());
        let _ = self.child.wait();
    }
}
