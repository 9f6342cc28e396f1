//! A scan as a picture of characters: seen from above, the sensor in the middle, its x axis up. Each character is 2 x 4 dots of braille.

use std::fmt::Write as _;

use carril_messages::LaserScan;

/// Characters across and down: as many dots in both directions.
const COLUMNS: usize = 60;
const ROWS: usize = COLUMNS / 2;
/// Dots from the middle to the edge.
const HALF: f64 = COLUMNS as f64;
/// The picture reaches to the farthest return but for this share: a stray one must not make all others small.
const SHOWN: f64 = 0.95;
/// It is never smaller than this, from the middle to the edge, m.
const LEAST_M: f64 = 0.5;
/// Distances from the middle to the edge that people can read, m.
const STEPS_M: [f64; 9] = [0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0, 100.0];
/// Bits of the dots of a braille character, by row and column.
const DOTS: [[u8; 2]; 4] = [[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]];

/// The picture, and under it how large it is and what is nearest.
pub fn scan(scan: &LaserScan) -> String {
    let points = points(scan);
    let reach_m = reach(&points);
    let mut cells = [[0_u8; COLUMNS]; ROWS];
    for (range_m, bearing_rad) in &points {
        let (up, left) = (range_m * bearing_rad.cos() / reach_m * HALF, range_m * bearing_rad.sin() / reach_m * HALF);
        let (x, y) = ((HALF - left).floor(), (HALF - up).floor());
        if x >= 0.0 && y >= 0.0 && x < 2.0 * HALF && y < 2.0 * HALF {
            let (x, y) = (x as usize, y as usize);
            cells[y / 4][x / 2] |= DOTS[y % 4][x % 2];
        }
    }
    let mut text = String::with_capacity(ROWS * COLUMNS * 3);
    for (row, line) in cells.iter().enumerate() {
        let line: String = line.iter().enumerate().map(|(column, dots)| character(row, column, *dots)).collect();
        text.push_str(line.trim_end());
        text.push('\n');
    }
    let nearest = points.iter().min_by(|a, b| a.0.total_cmp(&b.0)).map_or_else(
        || "no return".to_owned(),
        |(range_m, bearing_rad)| {
            let degrees = bearing_rad.to_degrees();
            let side = if degrees < 0.0 { "right" } else { "left" };
            format!("nearest {range_m:.2} m at {:.0}° {side}", degrees.abs())
        },
    );
    let _ = write!(text, "{:.0} returns, {nearest}; {} m from the middle to the edge, x up", points.len(), reach_m);
    text
}

/// A cell; the sensor itself is a caret.
fn character(row: usize, column: usize, dots: u8) -> char {
    match dots {
        0 if (row, column) == (ROWS / 2, COLUMNS / 2) => '^',
        0 => ' ',
        dots => char::from_u32(0x2800 + u32::from(dots)).unwrap_or('?'),
    }
}

/// Range and bearing of each return.
fn points(scan: &LaserScan) -> Vec<(f64, f64)> {
    let bearing = |index: usize| f64::from(scan.angle_min_rad) + f64::from(scan.angle_increment_rad) * index as f64;
    let returns = scan.ranges_m.iter().enumerate().map(|(index, range)| (f64::from(*range), bearing(index)));
    returns.filter(|(range_m, bearing)| *range_m > 0.0 && range_m.is_finite() && bearing.is_finite()).collect()
}

/// From the middle to the edge, m.
fn reach(points: &[(f64, f64)]) -> f64 {
    let mut ranges: Vec<f64> = points.iter().map(|(range_m, _)| *range_m).collect();
    ranges.sort_by(f64::total_cmp);
    let wanted = ranges.get(((ranges.len() as f64 - 1.0).max(0.0) * SHOWN).ceil() as usize).copied().unwrap_or(LEAST_M);
    STEPS_M.into_iter().find(|step_m| *step_m >= wanted).unwrap_or(wanted)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(ranges_m: Vec<f32>) -> LaserScan {
        let angle_increment_rad = std::f32::consts::TAU / ranges_m.len().max(1) as f32;
        LaserScan {
            angle_min_rad: 0.0,
            angle_increment_rad,
            scan_time_s: 0.1,
            range_min_m: 0.05,
            range_max_m: 12.0,
            ranges_m,
        }
    }

    #[test]
    fn ahead_is_up_and_left_is_left() {
        let mut ranges = vec![f32::INFINITY; 360];
        (ranges[0], ranges[91]) = (0.79, 0.39);
        let text = scan(&of(ranges));
        let lines: Vec<Vec<char>> = text.lines().map(|line| line.chars().collect()).collect();
        let at = |row: usize| lines[row].iter().position(|c| *c >= '\u{2800}' && *c != ' ');
        assert_eq!(at(3), Some(30), "0.79 m ahead, of 1 m: a fifth below the top, in the middle\n{text}");
        assert_eq!(at(15), Some(18), "0.39 m to the left: {text}");
        assert_eq!(lines[15][30], '^', "the sensor");
        assert!(
            text.ends_with("2 returns, nearest 0.39 m at 91° left; 1 m from the middle to the edge, x up"),
            "{text}"
        );
    }

    #[test]
    fn what_is_no_return_is_not_drawn() {
        let text = scan(&of(vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.0, -1.0]));
        assert!(text.contains("0 returns, no return"), "{text}");
        assert!(!text.chars().any(|c| ('\u{2801}'..='\u{28ff}').contains(&c)), "no dot: {text}");
        assert!(scan(&of(Vec::new())).contains("no return"), "an empty scan");
    }

    #[test]
    fn one_stray_return_does_not_make_the_rest_small() {
        let mut ranges = vec![1.5; 360];
        ranges[7] = 90.0;
        assert!(scan(&of(ranges)).contains("2 m from the middle"), "the rest decides");
    }
}
