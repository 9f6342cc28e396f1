use super::*;

/// A room: a wall all around, farther ahead, with noise.
struct Room {
    /// Bearings in degrees, width in degrees, range in metres.
    things: Vec<(f64, f64, f64)>,
    noise_m: f64,
    dropout: f64,
    points: usize,
}

impl Default for Room {
    fn default() -> Self {
        Self { things: Vec::new(), noise_m: 0.01, dropout: 0.02, points: 360 }
    }
}

fn unit(seed: u64) -> f64 {
    let mut x = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (x ^ (x >> 31)) as f64 / u64::MAX as f64
}

impl Room {
    fn scans(&self, count: u64, seed: u64) -> Vec<LaserScan> {
        (0..count).map(|number| self.scan(seed * 1000 + number)).collect()
    }

    fn scan(&self, seed: u64) -> LaserScan {
        let step = 360.0 / self.points as f64;
        let range = |ray: usize| {
            let bearing = -180.0 + ray as f64 * step;
            let wall = if (60.0..90.0).contains(&bearing) { f64::INFINITY } else { 2.0 + bearing.to_radians().cos() };
            let near = |(at, width, _): &&(f64, f64, f64)| {
                ((bearing - at + 180.0).rem_euclid(360.0) - 180.0).abs() <= width / 2.0
            };
            let range = self.things.iter().find(near).map_or(wall, |thing| thing.2);
            let random = |what: u64| unit(seed * 1_000_003 + ray as u64 * 7 + what);
            if random(1) < self.dropout { f64::INFINITY } else { range + self.noise_m * (random(2) * 2.0 - 1.0) * 1.7 }
        };
        LaserScan {
            angle_min_rad: -PI as f32,
            angle_increment_rad: step.to_radians() as f32,
            scan_time_s: 0.1,
            range_min_m: 0.05,
            range_max_m: 8.0,
            ranges_m: (0..self.points).map(|ray| range(ray) as f32).collect(),
        }
    }
}

fn with(things: &[(f64, f64, f64)]) -> Room {
    Room { things: things.to_vec(), ..Room::default() }
}

fn compare(before: &Room, after: &Room, scans: u64) -> Result<(Block, Figures), Refusal> {
    what_came_nearer(&before.scans(scans, 1), &after.scans(scans, 2), 0.05)
}

#[test]
fn a_box_is_found_wherever_it_stands() {
    for bearing in [-180.0, -179.0, -135.0, -91.0, 0.0, 3.0, 75.0, 120.0, 178.0] {
        for scans in [1, 10] {
            let (block, figures) = compare(&with(&[]), &with(&[(bearing, 20.0, 0.5)]), scans)
                .unwrap_or_else(|refusal| panic!("{bearing} in {scans}: {refusal:?}"));
            let off = (block.bearing_deg - bearing + 180.0).rem_euclid(360.0) - 180.0;
            assert!(off.abs() <= 1.5, "{bearing}: found at {block:?}");
            assert!((17.0..=23.0).contains(&block.width_deg), "{block:?}");
            assert!((0.45..0.55).contains(&block.after_m), "{block:?}");
            assert_eq!((figures.scans_before, figures.rays), (scans as usize, 360), "{figures:?}");
        }
    }
}

#[test]
fn a_box_where_nothing_was_in_reach_is_found() {
    let (block, _) = compare(&with(&[]), &with(&[(75.0, 20.0, 0.5)]), 10).expect("found");
    assert_eq!(block.before_m, None, "there was no wall");
}

#[test]
fn noise_holes_and_what_stood_there_before_are_no_box() {
    let noisy = |things: &[(f64, f64, f64)]| Room { noise_m: 0.03, dropout: 0.2, ..with(things) };
    for (scans, dropout) in [(1, 0.05), (10, 0.2)] {
        let room = || Room { dropout, ..noisy(&[(0.0, 20.0, 0.5)]) };
        let refusal = compare(&room(), &room(), scans).expect_err("nothing moved");
        assert!(matches!(refusal, Refusal::Nothing(_)), "{scans} scans: {refusal:?}");
    }
    let (block, _) = compare(&noisy(&[]), &noisy(&[(180.0, 24.0, 0.6)]), 10).expect("found all the same");
    assert!(block.bearing_deg.abs() > 177.0, "{block:?}");
    // Somebody who went away behind the car, and two things that are small.
    let before = with(&[(-120.0, 25.0, 0.9)]);
    let after = with(&[(10.0, 30.0, 0.5), (100.0, 4.0, 1.0), (-60.0, 7.0, 1.5)]);
    let (block, figures) = compare(&before, &after, 10).expect("the large one");
    assert!((block.bearing_deg - 10.0).abs() <= 1.5 && figures.blocks <= 3, "{block:?} {figures:?}");
}

#[test]
fn too_little_too_much_and_two_boxes_are_refused_with_figures() {
    let refused = |after: &Room| compare(&with(&[]), after, 5).expect_err("refused");
    assert!(matches!(refused(&with(&[(0.0, 1.0, 0.5)])), Refusal::Nothing(figures) if figures.nearer <= 3), "a pole");
    let two = refused(&with(&[(0.0, 20.0, 0.5), (120.0, 18.0, 0.7)]));
    let Refusal::Several(_, blocks) = two else { panic!("{two:?}") };
    let [first, second] = *blocks;
    assert!(first.bearing_deg.abs() < 2.0 && (second.bearing_deg - 120.0).abs() < 2.0, "{first:?} {second:?}");
    let moved = with(&[(0.0, 200.0, 0.8)]);
    assert!(matches!(refused(&moved), Refusal::TooMuch(figures) if figures.nearer > 190), "{:?}", refused(&moved));
}

#[test]
fn scans_that_do_not_fit_together_are_refused() {
    let scan = with(&[]).scans(1, 1);
    let coarse = Room { points: 180, ..Room::default() }.scans(1, 1);
    for (before, after, says) in [
        (&scan[..], &coarse[..], "do not fit together"),
        (&[], &scan, "no scan before"),
        (&scan, &[], "no scan after"),
        (
            &[LaserScan { ranges_m: vec![1.0; 3], ..scan[0].clone() }],
            &[LaserScan { ranges_m: vec![1.0; 3], ..scan[0].clone() }],
            "3 points",
        ),
        (&[LaserScan { angle_min_rad: f32::NAN, ..scan[0].clone() }], &scan, "angle_min_rad"),
    ] {
        let refusal = what_came_nearer(before, after, 0.0).expect_err("refused");
        assert!(matches!(&refusal, Refusal::Scan(reason) if reason.contains(says)), "`{says}` in {refusal:?}");
    }
}

#[test]
fn the_mounting_turns_what_was_found_to_where_it_is() {
    for (bearing, wanted, mounting) in [
        (180.0, 0.0, 180.0),
        (-180.0, 0.0, 180.0),
        (0.0, 0.0, 0.0),
        (-90.0, 0.0, 90.0),
        (90.0, 180.0, 90.0),
        (10.0, -90.0, -100.0),
    ] {
        assert_eq!(mounting_deg(bearing, wanted), mounting, "{bearing} is at {wanted}");
    }
}
