//! Sectors from scans good and bad, and what must hold for any scan.

use carril_runtime::Trigger;
use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::testing::{at_ms, context, header, problems};

/// 360 rays of 1 degree from -180 degrees on, all free.
fn free_scan() -> LaserScan {
    LaserScan {
        angle_min_rad: -std::f32::consts::PI,
        angle_increment_rad: std::f32::consts::PI / 180.0,
        scan_time_s: 0.1,
        range_min_m: 0.1,
        range_max_m: 16.0,
        ranges_m: vec![f32::INFINITY; 360],
    }
}

/// Puts returns at `range_m` into the rays from `from_deg` to `to_deg`, sensor frame.
fn with(mut scan: LaserScan, from_deg: i32, to_deg: i32, range_m: f32) -> LaserScan {
    for degree in from_deg..=to_deg {
        scan.ranges_m[(degree + 180).rem_euclid(360) as usize] = range_m;
    }
    scan
}

fn reduce(config: serde_json::Value, scan: &LaserScan) -> Sectors {
    let config = serde_json::from_value(config).expect("a valid configuration");
    LidarSectors::from_config(config).reduce(scan).expect("a valid scan")
}

fn sector(sectors: &Sectors, name: &str) -> Sector {
    sectors.get(name).unwrap_or_else(|| panic!("no sector `{name}` in {sectors:?}")).clone()
}

#[test]
fn free_all_around() {
    for sector in reduce(json!({}), &free_scan()).sectors {
        assert_eq!((sector.nearest_m, sector.returns_within, sector.occupied), (None, 0, false), "{}", sector.name);
        assert_eq!(sector.coverage, 1.0, "`inf` is a measurement: {}", sector.name);
        assert!(sector.from_rad <= sector.to_rad, "{}", sector.name);
    }
}

#[test]
fn finds_the_nearest_return_and_its_bearing() {
    let scan = with(with(free_scan(), -5, 5, 0.8), 3, 3, 0.5);
    let front = sector(&reduce(json!({}), &scan), "front");
    assert_eq!(front.nearest_m, Some(0.5), "the nearest");
    let bearing = front.nearest_bearing_rad.expect("the nearest has a bearing");
    assert!((bearing - 3_f32.to_radians()).abs() < 1e-4, "3 degrees to the left, got {bearing} rad");
    assert_eq!((front.returns_within, front.occupied), (11, true), "all eleven lie within 1 m");
}

#[test]
fn fewer_returns_than_configured_are_noise() {
    let front = sector(&reduce(json!({}), &with(free_scan(), 0, 1, 0.5)), "front");
    assert_eq!((front.returns_within, front.occupied), (2, false), "two are noise");
    let front = sector(&reduce(json!({}), &with(free_scan(), 0, 2, 0.5)), "front");
    assert_eq!((front.returns_within, front.occupied), (3, true), "three are not");
}

#[test]
fn a_sector_runs_through_180_degrees() {
    let rear = sector(&reduce(json!({}), &with(free_scan(), 175, 184, 0.4)), "rear");
    assert_eq!((rear.returns_within, rear.coverage), (10, 1.0), "on both sides of 180 degrees");
    assert!((rear.to_rad - 210_f32.to_radians()).abs() < 1e-5, "ends at 210 degrees, not at -150: {rear:?}");
    let scan = with(free_scan(), 100, 130, 0.4);
    assert_eq!(sector(&reduce(json!({}), &scan), "rear").returns_within, 0, "beside it");
}

#[test]
fn edges_belong_to_the_sector() {
    let config = json!({"sectors": [{"name": "a", "from_deg": -10, "to_deg": 20}]});
    let a = sector(&reduce(config, &with(free_scan(), -180, 179, 0.5)), "a");
    assert_eq!(a.returns_within, 31, "-10 to 20 degrees, both included");
    let config = json!({"sectors": [{"name": "all", "from_deg": -180, "to_deg": 180}]});
    let all = sector(&reduce(config, &with(free_scan(), -180, 179, 0.5)), "all");
    assert_eq!(all.returns_within, 360, "all around");
}

#[test]
fn a_lidar_mounted_backwards_still_sees_ahead() {
    let scan = with(free_scan(), 175, 184, 0.4);
    let front = sector(&reduce(json!({"mounting_deg": 180}), &scan), "front");
    assert_eq!(front.returns_within, 10, "behind the lidar is ahead of the car");
    let bearing = front.nearest_bearing_rad.expect("there is a nearest");
    assert!(bearing.abs() <= 5_f32.to_radians() + 1e-4, "body frame, got {bearing} rad");
}

#[test]
fn the_cars_own_parts_are_masked() {
    let scan = with(free_scan(), -12, -8, 0.2);
    let masks = json!({"masks": [{"from_deg": -13, "to_deg": -7}]});
    let front = sector(&reduce(masks, &scan), "front");
    assert_eq!((front.nearest_m, front.coverage), (None, 1.0), "as if the rays were not there");
    let all = sector(&reduce(json!({"masks": [{"from_deg": -180, "to_deg": 180}]}), &scan), "front");
    assert_eq!(all.coverage, 0.0, "a sector without rays is blind");
}

#[test]
fn holes_are_not_free() {
    for hole in [f32::NAN, f32::NEG_INFINITY, 0.0, -1.0, 0.09] {
        let front = sector(&reduce(json!({}), &with(free_scan(), -30, 30, hole)), "front");
        assert_eq!((front.nearest_m, front.coverage), (None, 0.0), "{hole} measures nothing");
    }
    let far = sector(&reduce(json!({}), &with(free_scan(), -30, 30, 17.0)), "front");
    assert_eq!((far.nearest_m, far.coverage), (None, 1.0), "beyond the device's reach is free");
    let near = json!({"min_range_m": 0.6});
    assert_eq!(sector(&reduce(near, &with(free_scan(), 0, 0, 0.5)), "front").nearest_m, None, "nearer than configured");
}

#[test]
fn refuses_a_scan_that_makes_no_sense_and_goes_on() {
    let mut operator = LidarSectors::from_config(LidarSectorsConfig::default());
    let (mut inputs, mut outputs) = (LidarSectorsInputs::default(), LidarSectorsOutputs::default());
    for spoil in [
        |scan: &mut LaserScan| scan.angle_min_rad = f32::NAN,
        |scan: &mut LaserScan| scan.angle_increment_rad = f32::INFINITY,
        |scan: &mut LaserScan| scan.range_min_m = f32::NAN,
        |scan: &mut LaserScan| scan.range_max_m = -1.0,
        |scan: &mut LaserScan| scan.ranges_m = vec![1.0; MAX_SCAN_POINTS + 1],
    ] {
        let mut bad = free_scan();
        spoil(&mut bad);
        inputs.scan.put(bad, header::<LaserScan>(at_ms(1)));
        inputs.scan.put(free_scan(), header::<LaserScan>(at_ms(2)));
        let result = operator.step(&mut inputs, &mut outputs, &context(at_ms(3), Trigger::Input));
        assert!(result.is_err(), "the bad scan is reported");
        assert_eq!(outputs.sectors.sent().len(), 1, "the good one behind it is answered");
    }
}

#[test]
fn every_bound_is_checked() {
    let sector = |field: &str, value: serde_json::Value| {
        let mut sector = json!({"name": "a", "from_deg": -10, "to_deg": 10});
        sector[field] = value;
        json!({ "sectors": [sector] })
    };
    let many: Vec<_> = (0..33).map(|i| json!({"name": i.to_string(), "from_deg": 0, "to_deg": 1})).collect();
    for (config, field) in [
        (json!({"sectors": []}), "sectors"),
        (json!({ "sectors": many }), "sectors"),
        (
            json!({"sectors": [{"name": "a", "from_deg": 0, "to_deg": 1}, {"name": "a", "from_deg": 1, "to_deg": 2}]}),
            "sectors.1.name",
        ),
        (sector("name", json!("")), "sectors.0.name"),
        (sector("from_deg", json!(-361)), "sectors.0.from_deg"),
        (sector("to_deg", json!(361)), "sectors.0.to_deg"),
        (sector("to_deg", json!(-10)), "sectors.0.to_deg"),
        (sector("limit_m", json!(0)), "sectors.0.limit_m"),
        (sector("limit_m", json!(101)), "sectors.0.limit_m"),
        (sector("min_returns", json!(0)), "sectors.0.min_returns"),
        (json!({"mounting_deg": 361}), "mounting_deg"),
        (json!({"masks": [{"from_deg": 5, "to_deg": 5}]}), "masks.0.to_deg"),
        (json!({"masks": [{"from_deg": 500, "to_deg": 5}]}), "masks.0.from_deg"),
        (json!({"min_range_m": -0.1}), "min_range_m"),
    ] {
        let found = problems::<LidarSectors>(&config);
        assert!(found.iter().any(|one| one.starts_with(&format!("{field}: "))), "{config}: {found:?}");
    }
    assert_eq!(problems::<LidarSectors>(&json!({})), Vec::<String>::new(), "the defaults pass");
}

#[test]
fn nan_is_refused_everywhere() {
    let nan = f64::NAN;
    let sector = SectorConfig { name: "a".into(), from_deg: nan, to_deg: nan, limit_m: nan, min_returns: 1 };
    let masks = vec![MaskConfig { from_deg: nan, to_deg: nan }];
    let config = LidarSectorsConfig { sectors: vec![sector], mounting_deg: nan, masks, min_range_m: nan };
    let fields = crate::testing::fields_found(&config);
    for field in [
        "sectors.0.from_deg",
        "sectors.0.to_deg",
        "sectors.0.limit_m",
        "mounting_deg",
        "masks.0.from_deg",
        "min_range_m",
    ] {
        assert!(fields.iter().any(|found| found == field), "{field} is not in {fields:?}");
    }
}

proptest! {
    #[test]
    fn any_scan_gives_sane_sectors_or_an_error(
        angle_min_rad: f32,
        angle_increment_rad: f32,
        range_min_m: f32,
        range_max_m: f32,
        small_angles: bool,
        ranges_m in proptest::collection::vec(any::<f32>(), 0..500),
    ) {
        let squeeze = |angle: f32| if small_angles && angle.is_finite() { angle % 3.0 } else { angle };
        let scan = LaserScan {
            angle_min_rad: squeeze(angle_min_rad),
            angle_increment_rad: squeeze(angle_increment_rad),
            scan_time_s: 0.1,
            range_min_m: if small_angles { 0.0 } else { range_min_m },
            range_max_m: if small_angles { 1e3 } else { range_max_m },
            ranges_m,
        };
        if let Ok(sectors) = LidarSectors::from_config(LidarSectorsConfig::default()).reduce(&scan) {
            for sector in sectors.sectors {
                prop_assert!((0.0..=1.0).contains(&sector.coverage), "{sector:?}");
                prop_assert!(sector.nearest_m.is_none_or(|range| range.is_finite() && range > 0.0), "{sector:?}");
                prop_assert_eq!(sector.nearest_m.is_some(), sector.nearest_bearing_rad.is_some());
                prop_assert!(sector.nearest_m.is_some() || sector.returns_within == 0, "{sector:?}");
            }
        }
    }
}
