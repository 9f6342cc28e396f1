//! Scans of a lidar in a file, as `carril echo world/scan --json` prints them: one object after another, those with statistics between.

use std::path::Path;

use anyhow::{Context, Result, anyhow, bail};
use carril_messages::{LaserScan, Message};
use serde::Deserialize;
use serde_json::Value;

/// No recording is larger, B: an hour of scans has a tenth of it.
const MAX_BYTES: u64 = 256 << 20;

/// A scan in JSON, which has no infinity: a ray without a return is `null`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenScan {
    angle_min_rad: f32,
    angle_increment_rad: f32,
    scan_time_s: f32,
    range_min_m: f32,
    range_max_m: f32,
    ranges_m: Vec<Option<f32>>,
}

/// Every scan of a file.
pub fn read(path: &Path) -> Result<Vec<LaserScan>> {
    let shown = path.display();
    let size = std::fs::metadata(path).with_context(|| format!("cannot read `{shown}`"))?.len();
    if size > MAX_BYTES {
        bail!(
            "`{shown}` has {size} B, allowed are at most {MAX_BYTES} B; record fewer scans (`carril echo ... -n 20 --json`)"
        );
    }
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read `{shown}`"))?;
    parse(&text).map_err(|why| {
        anyhow!("`{shown}`: {why}\nhint: record it with `carril echo world/scan -n 10 --json > {shown}`")
    })
}

fn parse(text: &str) -> Result<Vec<LaserScan>, String> {
    let mut scans = Vec::new();
    let mut values = serde_json::Deserializer::from_str(text).into_iter::<Value>();
    loop {
        let line = |at: usize| text[..at].matches('\n').count() + 1;
        let at = text[values.byte_offset()..].trim_start();
        let at = text.len() - at.len();
        let value = match values.next() {
            None => break,
            Some(Ok(value)) => value,
            Some(Err(error)) => return Err(format!("no JSON: {error}")),
        };
        if let Some(scan) = scan_in(&value).map_err(|why| format!("line {}: {why}", line(at)))? {
            scans.push(scan);
        }
    }
    if scans.is_empty() { Err("there is no scan in it".into()) } else { Ok(scans) }
}

/// The scan that an object holds: as `value` of a sample, or as itself. `None`: it is something else.
fn scan_in(value: &Value) -> Result<Option<LaserScan>, String> {
    if let Some(kind) = value.get("type").and_then(Value::as_str)
        && kind.split(' ').next().is_some_and(|name| LaserScan::TYPE.name != name)
    {
        return Err(format!("got a sample of `{kind}`, allowed is `{}`", LaserScan::TYPE.name));
    }
    let Some(scan) = value.get("value").or_else(|| value.get("ranges_m").map(|_| value)) else { return Ok(None) };
    let WrittenScan { angle_min_rad, angle_increment_rad, scan_time_s, range_min_m, range_max_m, ranges_m } =
        WrittenScan::deserialize(scan).map_err(|error| format!("no scan: {error}"))?;
    let ranges_m = ranges_m.into_iter().map(|range| range.unwrap_or(f32::INFINITY)).collect();
    Ok(Some(LaserScan { angle_min_rad, angle_increment_rad, scan_time_s, range_min_m, range_max_m, ranges_m }))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCAN: &str = r#"{"angle_min_rad":-3.14,"angle_increment_rad":0.1,"scan_time_s":0.1,"range_min_m":0.1,"range_max_m":8,"ranges_m":[1.5,null]}"#;

    #[test]
    fn reads_samples_and_bare_scans_and_passes_over_statistics() {
        let text = format!("{{\"type\":\"carril/LaserScan v1\",\"value\":{SCAN}}}\n{{\"statistics\":[]}}\n{SCAN}");
        let scans = parse(&text).expect("two scans");
        assert_eq!(scans.len(), 2, "without the statistics");
        assert_eq!(scans[0].ranges_m, [1.5, f32::INFINITY], "null is no return");
    }

    #[test]
    fn says_what_is_no_scan_and_where() {
        for (text, says) in [
            ("", "no scan in it"),
            ("{\"statistics\":[]}", "no scan in it"),
            ("nonsense", "line 1 column 2"),
            ("\n\n{\"type\":\"carril/Image v1\",\"value\":{}}", "line 3: got a sample of `carril/Image v1`"),
            ("{\"value\":{\"ranges_m\":[\"near\"]}}", "line 1: no scan"),
        ] {
            let error = parse(text).expect_err("refused");
            assert!(error.contains(says), "{text}: `{says}` in `{error}`");
        }
    }
}
