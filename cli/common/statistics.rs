//! What was seen of a stream of samples: rate, jitter, losses, bytes, delays. Pure: arrivals in, numbers out.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::sync::Arc;

use carril_messages::{Header, SourceId, Stamp};
use hdrhistogram::Histogram;
use serde::Serialize;

/// Longest period or delay that is told apart, ns: an hour. Longer ones count as an hour.
const LONGEST_NS: u64 = 3_600_000_000_000;

/// A stream of samples, as it was seen.
pub struct Statistics {
    port: String,
    message_type: Option<String>,
    count: u64,
    lost: u64,
    restarts: u64,
    refused: u64,
    bytes: u64,
    smallest: u64,
    largest: u64,
    previous: Option<Previous>,
    periods: Histogram<u64>,
    transport: Histogram<u64>,
    age: Histogram<u64>,
    sensors: Arc<Sensors>,
    age_by_sensor: BTreeMap<String, Histogram<u64>>,
}

/// Names of the ports that exposures may come from: `world/camera`.
pub type Sensors = HashMap<SourceId, String>;

#[derive(Clone, Copy)]
struct Previous {
    epoch: u64,
    seq: u64,
    arrived: Stamp,
}

impl Statistics {
    /// Of a stream that has not begun.
    pub fn new(port: &str, sensors: &Arc<Sensors>) -> Self {
        Self {
            sensors: Arc::clone(sensors),
            age_by_sensor: BTreeMap::new(),
            port: port.to_owned(),
            message_type: None,
            count: 0,
            lost: 0,
            restarts: 0,
            refused: 0,
            bytes: 0,
            smallest: u64::MAX,
            largest: 0,
            previous: None,
            periods: histogram(),
            transport: histogram(),
            age: histogram(),
        }
    }

    /// Takes note of a sample of `bytes` that came at `arrived`, on the car's clock.
    pub fn record(&mut self, header: &Header, bytes: usize, arrived: Stamp) {
        let bytes = bytes as u64;
        self.count += 1;
        self.bytes += bytes;
        self.smallest = self.smallest.min(bytes);
        self.largest = self.largest.max(bytes);
        if self.message_type.is_none() {
            self.message_type = Some(header.message_type.to_string());
        }
        note(&mut self.transport, arrived.since(header.stamp).as_nanos());
        if let Some(captured) = header.origins.oldest() {
            note(&mut self.age, arrived.since(captured).as_nanos());
        }
        for origin in header.origins.iter() {
            let Some(sensor) = self.sensors.get(&origin.source) else { continue };
            // A sensor's name is copied once only: this runs for every sample.
            if !self.age_by_sensor.contains_key(sensor) {
                self.age_by_sensor.insert(sensor.clone(), histogram());
            }
            let ages = self.age_by_sensor.get_mut(sensor).expect("it was put there above");
            note(ages, arrived.since(origin.stamp).as_nanos());
        }
        if let Some(previous) = self.previous {
            note(&mut self.periods, arrived.since(previous.arrived).as_nanos());
            if previous.epoch == header.epoch {
                self.lost += header.seq.saturating_sub(previous.seq.saturating_add(1));
            } else {
                self.restarts += 1;
            }
        }
        self.previous = Some(Previous { epoch: header.epoch, seq: header.seq, arrived });
    }

    /// Takes note of a sample that could not be read.
    pub fn record_refused(&mut self) {
        self.refused += 1;
    }

    /// Samples so far.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Begins a new window: everything from 0, but the next period begins at the last sample of this one.
    pub fn next_window(&mut self) -> Summary {
        let summary = self.summary();
        let previous = self.previous;
        *self = Self::new(&self.port, &self.sensors);
        self.previous = previous;
        summary
    }

    /// The numbers.
    pub fn summary(&self) -> Summary {
        let mean_s = (!self.periods.is_empty()).then(|| self.periods.mean() * 1e-9);
        let rate_hz = mean_s.filter(|mean| *mean > 0.0).map(|mean| 1.0 / mean);
        let mean_b = (self.count > 0).then(|| self.bytes as f64 / self.count as f64);
        Summary {
            port: self.port.clone(),
            message_type: self.message_type.clone(),
            count: self.count,
            lost: self.lost,
            restarts: self.restarts,
            refused: self.refused,
            rate_hz,
            period_ms: spread(&self.periods),
            bytes: self.bytes,
            size_b: mean_b.map(|mean| Sizes { min: self.smallest, mean, max: self.largest }),
            bandwidth_b_s: rate_hz.zip(mean_b).map(|(rate, mean)| rate * mean),
            transport_ms: quantiles(&self.transport),
            age_ms: quantiles(&self.age),
            age_ms_by_sensor: self.ages_by_sensor(),
        }
    }
}

impl Statistics {
    fn ages_by_sensor(&self) -> BTreeMap<String, Quantiles> {
        self.age_by_sensor.iter().filter_map(|(name, ages)| Some((name.clone(), quantiles(ages)?))).collect()
    }
}

fn histogram() -> Histogram<u64> {
    Histogram::new_with_bounds(1, LONGEST_NS, 3).expect("the bounds are valid")
}

/// A negative span (two clocks that differ) counts as the shortest.
fn note(histogram: &mut Histogram<u64>, nanos: i64) {
    histogram.saturating_record(nanos.max(0) as u64);
}

/// ns to ms, without digits that nobody measured.
fn ms(nanos: f64) -> f64 {
    nanos.round() / 1e6
}

fn quantiles(histogram: &Histogram<u64>) -> Option<Quantiles> {
    let ms = |nanos: u64| ms(nanos as f64);
    (!histogram.is_empty()).then(|| Quantiles {
        p50: ms(histogram.value_at_quantile(0.5)),
        p99: ms(histogram.value_at_quantile(0.99)),
        max: ms(histogram.max()),
    })
}

fn spread(histogram: &Histogram<u64>) -> Option<Spread> {
    (!histogram.is_empty()).then(|| Spread {
        min: ms(histogram.min() as f64),
        mean: ms(histogram.mean()),
        max: ms(histogram.max() as f64),
        jitter: ms(histogram.stdev()),
    })
}

/// The numbers of a stream.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// `node/port`
    pub port: String,
    /// Name and version; `None` before the first sample.
    pub message_type: Option<String>,
    /// Samples.
    pub count: u64,
    /// Samples that never came: gaps in the sequence numbers.
    pub lost: u64,
    /// How often the writer began anew.
    pub restarts: u64,
    /// Samples that could not be read.
    pub refused: u64,
    /// Samples per second. `None` before the second sample.
    pub rate_hz: Option<f64>,
    /// From one arrival to the next, ms.
    pub period_ms: Option<Spread>,
    /// Payload bytes.
    pub bytes: u64,
    /// Bytes of a sample.
    pub size_b: Option<Sizes>,
    /// Payload bytes per second.
    pub bandwidth_b_s: Option<f64>,
    /// From publication to arrival here, ms.
    pub transport_ms: Option<Quantiles>,
    /// From the oldest exposure to arrival here, ms. `None`: nothing derives from a sensor.
    pub age_ms: Option<Quantiles>,
    /// The same for each sensor by itself.
    pub age_ms_by_sensor: BTreeMap<String, Quantiles>,
}

/// Minimum, mean, maximum and standard deviation, ms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Shortest.
    pub min: f64,
    /// Mean.
    pub mean: f64,
    /// Longest.
    pub max: f64,
    /// Standard deviation.
    pub jitter: f64,
}

/// Median, 99th percentile and maximum, ms.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Quantiles {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Maximum.
    pub max: f64,
}

/// Sizes, B.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Sizes {
    /// Smallest.
    pub min: u64,
    /// Mean.
    pub mean: f64,
    /// Largest.
    pub max: u64,
}

impl Summary {
    /// `30.0 Hz   period 31.2 .. 35.1 ms   jitter 0.42 ms   0 lost`
    pub fn rate_text(&self) -> String {
        match (self.rate_hz, self.period_ms) {
            (Some(rate), Some(period)) => format!(
                "{rate:.1} Hz   period {:.2} .. {:.2} ms   jitter {:.2} ms   {} lost",
                period.min, period.max, period.jitter, self.lost
            ),
            _ => self.too_few("a rate needs two samples"),
        }
    }

    /// `27.6 MB/s   921.6 kB each`
    pub fn bandwidth_text(&self) -> String {
        match (self.bandwidth_b_s, self.size_b) {
            (Some(bandwidth), Some(size)) => format!("{}/s   {}", super::output::bytes(bandwidth), size),
            _ => self.too_few("a bandwidth needs two samples"),
        }
    }

    /// `transport p50 0.131 p99 0.402 max 0.610 ms   age p50 3.4 ...`
    pub fn delay_text(&self) -> String {
        let Some(transport) = self.transport_ms else { return self.too_few("nothing came") };
        let mut parts = vec![format!("since publication {transport}")];
        parts.extend(self.age_ms_by_sensor.iter().map(|(sensor, age)| format!("since {sensor} {age}")));
        if self.age_ms.is_none() {
            parts.push("derives from no sensor".to_owned());
        }
        parts.join("   ")
    }

    fn too_few(&self, why: &str) -> String {
        format!("{} so far; {why}", super::output::counted(self.count, "sample"))
    }
}

impl fmt::Display for Quantiles {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "p50 {:.3} p99 {:.3} max {:.3} ms", self.p50, self.p99, self.max)
    }
}

impl fmt::Display for Sizes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let bytes = |count: f64| super::output::bytes(count);
        if self.min == self.max {
            return write!(f, "{} each", bytes(self.mean));
        }
        write!(f, "{} to {} each, mean {}", bytes(self.min as f64), bytes(self.max as f64), bytes(self.mean))
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "--- {}: {}, {} lost", self.port, super::output::counted(self.count, "sample"), self.lost)?;
        if self.restarts > 0 {
            write!(f, ", writer restarted {}", super::output::counted(self.restarts, "time"))?;
        }
        if self.refused > 0 {
            write!(f, ", {} not readable", self.refused)?;
        }
        writeln!(f, " ---")?;
        if let (Some(rate), Some(period)) = (self.rate_hz, self.period_ms) {
            writeln!(f, "rate    {rate:.2} Hz")?;
            writeln!(
                f,
                "period  min {:.2} mean {:.2} max {:.2} ms, jitter {:.2} ms",
                period.min, period.mean, period.max, period.jitter
            )?;
        }
        if let Some(size) = self.size_b {
            let total = super::output::bytes(self.bytes as f64);
            let bandwidth = self.bandwidth_b_s.map(|b| format!(", {}/s", super::output::bytes(b))).unwrap_or_default();
            writeln!(f, "bytes   {total}, {size}{bandwidth}")?;
        }
        if let Some(transport) = self.transport_ms {
            writeln!(f, "delay   {transport}, publication to here")?;
        }
        for (sensor, age) in &self.age_ms_by_sensor {
            writeln!(f, "age     {age}, exposure of {sensor} to here")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use carril_messages::{Command, Message, Meta, Origins};

    use super::*;

    const MS: i64 = 1_000_000;

    fn header(epoch: u64, seq: u64, published: i64) -> Header {
        let stamp = Stamp::from_nanos(published);
        let origins = Origins::captured(SourceId::of("world", "camera"), Stamp::from_nanos(published - 3 * MS));
        Header { epoch, seq, stamp, origins, message_type: Command::TYPE, meta: Meta::new() }
    }

    fn sensors() -> Arc<Sensors> {
        Arc::new(Sensors::from([(SourceId::of("world", "camera"), "world/camera".to_owned())]))
    }

    fn seen(samples: &[(u64, u64, i64)]) -> Statistics {
        let mut statistics = Statistics::new("decision/command", &sensors());
        for (epoch, seq, at) in samples {
            statistics.record(&header(*epoch, *seq, at * MS), 16, Stamp::from_nanos((at + 1) * MS));
        }
        statistics
    }

    fn near(got: Option<f64>, expected: f64) -> bool {
        got.is_some_and(|got| (got - expected).abs() <= 0.01 * expected)
    }

    #[test]
    fn a_steady_stream_has_its_rate_and_no_jitter() {
        let summary = seen(&[(1, 0, 100), (1, 1, 120), (1, 2, 140)]).summary();
        assert!(near(summary.rate_hz, 50.0), "20 ms apart: {summary:?}");
        let period = summary.period_ms.expect("two periods");
        assert!(period.jitter < 0.1 && near(Some(period.max), 20.0), "{period:?}");
        assert!(near(summary.bandwidth_b_s, 800.0), "50 times 16 B: {summary:?}");
        assert!(near(summary.transport_ms.map(|q| q.p50), 1.0), "1 ms on the way: {summary:?}");
        assert!(near(summary.age_ms.map(|q| q.max), 4.0), "exposed 3 ms before publication: {summary:?}");
        let camera = summary.age_ms_by_sensor.get("world/camera").map(|q| q.max);
        assert!(near(camera, 4.0), "the sensor is named: {summary:?}");
    }

    #[test]
    fn tells_lost_samples_from_a_restart() {
        let summary = seen(&[(1, 5, 0), (1, 8, 30), (2, 0, 60), (2, 1, 70)]).summary();
        assert_eq!((summary.lost, summary.restarts), (2, 1), "6 and 7 are lost; a new epoch begins at 0");
    }

    #[test]
    fn a_repeated_number_is_no_loss() {
        assert_eq!(seen(&[(1, u64::MAX, 0), (1, 3, 10)]).summary().lost, 0, "numbers that fall never underflow");
    }

    #[test]
    fn a_window_begins_where_the_last_one_ended() {
        let mut statistics = seen(&[(1, 0, 0), (1, 1, 10)]);
        assert!(near(statistics.next_window().rate_hz, 100.0), "first window");
        assert_eq!(statistics.next_window().rate_hz, None, "nothing in the second");
        statistics.record(&header(1, 4, 30 * MS), 16, Stamp::from_nanos(31 * MS));
        let summary = statistics.next_window();
        assert!(near(summary.rate_hz, 50.0), "20 ms since the last sample of the first window: {summary:?}");
        assert_eq!(summary.lost, 2, "2 and 3 are missing across the border");
    }

    #[test]
    fn one_sample_has_no_rate_and_says_so() {
        let summary = seen(&[(1, 0, 0)]).summary();
        assert_eq!(summary.rate_text(), "1 sample so far; a rate needs two samples", "text");
        assert_eq!(
            serde_json::to_value(&summary).expect("numbers are JSON")["rate_hz"],
            serde_json::Value::Null,
            "JSON"
        );
    }

    #[test]
    fn stamps_from_nowhere_never_panic() {
        let mut statistics = Statistics::new("x/y", &sensors());
        for at in [i64::MIN, i64::MAX, 0] {
            statistics.record(&header(0, 0, at.saturating_add(3 * MS)), 0, Stamp::from_nanos(at));
        }
        assert_eq!(statistics.count(), 3, "all counted");
    }
}
