//! A small world for tests: boxes in a row, a lidar in the middle of the front of the car, noise.

use super::geometry::Place;

/// Where the lidar is, ahead of the rear axle, m.
pub const LIDAR_M: f64 = 0.18;

/// Numbers that look random, the same each time.
pub struct Noise(u64);

impl Noise {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    /// 0 to 1.
    pub fn unit(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Mean 0, deviation 1, near enough.
    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
    }
}

/// Walls that the lidar sees, row frame.
#[derive(Clone, Default)]
pub struct World {
    pub walls: Vec<[[f64; 2]; 2]>,
}

impl World {
    /// Cars by the place of their rear and their length, m, 0.19 m wide, their flank at y = 0.
    pub fn row(cars: &[(f64, f64)]) -> Self {
        let mut world = Self::default();
        for (rear_m, length_m) in cars {
            world.add_box([rear_m + length_m / 2.0, -0.095], [*length_m, 0.19]);
        }
        world
    }

    /// A box by its middle and its size.
    pub fn add_box(&mut self, [x, y]: [f64; 2], [length, width]: [f64; 2]) {
        let (l, w) = (length / 2.0, width / 2.0);
        let corners = [[x - l, y - w], [x + l, y - w], [x + l, y + w], [x - l, y + w]];
        self.walls.extend((0..4).map(|i| [corners[i], corners[(i + 1) % 4]]));
    }

    /// A scan's points in the body frame: a ray per degree, 1 cm of noise, one in a hundred lost, posts at 150 degrees.
    pub fn scan(&self, at: Place, noise: &mut Noise) -> Vec<[f64; 2]> {
        let lidar = at.place(Place::new(LIDAR_M, 0.0, 0.0));
        let walls: Vec<_> = self.walls.iter().map(|wall| wall.map(|end| lidar.seen(end))).collect();
        let ray = |degree: i32| {
            let (sin, cos) = f64::from(degree).to_radians().sin_cos();
            let hits = walls.iter().filter_map(|[a, b]| {
                let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
                let turn = cos * dy - sin * dx;
                let (range, share) = ((a[0] * dy - a[1] * dx) / turn, (a[0] * sin - a[1] * cos) / turn);
                (range > 0.0 && (0.0..=1.0).contains(&share)).then_some(range)
            });
            (hits.fold(f64::INFINITY, f64::min), cos, sin)
        };
        let mut points = Vec::new();
        for degree in -180..180_i32 {
            let (range, cos, sin) = ray(degree);
            let (range, lost) = (range + 0.01 * noise.normal(), noise.unit() < 0.01);
            if range < 3.0 && !lost && (degree.abs() - 150).abs() > 4 {
                points.push([LIDAR_M + range * cos, range * sin]);
            }
        }
        points
    }
}

impl World {
    /// Whether the car at a place touches a wall.
    pub fn touches(&self, car: &super::geometry::Car, at: Place) -> bool {
        self.walls.iter().any(|[a, b]| {
            // Walls are short: points every 5 mm and the ends.
            let steps = ((a[0] - b[0]).hypot(a[1] - b[1]) / 0.005).ceil();
            let near = (a[0] - at.x_m).abs().min((b[0] - at.x_m).abs()) < 0.8;
            near && (0..=steps as u32).any(|step| {
                let share = f64::from(step) / steps;
                car.covers(at.seen([a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]), 0.0)
            })
        })
    }
}
