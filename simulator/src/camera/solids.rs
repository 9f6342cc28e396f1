//! Boxes, walls and traffic lights as the camera sees them: convex faces, clipped, projected and filled, far ones first.

use carril_messages::Pose;
use nalgebra::{Isometry2, Point2, Point3, Vector3};

use super::Scene;
use super::model::CameraModel;
use crate::track::{Bgr, Block, Track};
use crate::traffic_light::{self, HungLamp, TrafficLight};

/// Nothing nearer to the camera is drawn, m.
const NEAR_M: f64 = 0.02;
/// Where light comes from, map frame; makes the faces of a box differ.
const LIGHT: [f64; 3] = [0.36, 0.48, 0.80];

/// A lamp lies on its housing, and is drawn as if it were so much nearer, m.
const LAMP_NEARER_M: f64 = 0.05;

/// A flat convex face in the map frame, counter-clockwise from outside.
#[derive(Clone, Debug)]
struct Face {
    corners: Vec<Point3<f64>>,
    two_sided: bool,
    colour: Bgr,
}

/// Every face of a track's boxes, walls and traffic lights.
#[derive(Clone, Debug, Default)]
pub struct Solids {
    faces: Vec<Face>,
    /// With the light that they belong to.
    lamps: Vec<(usize, HungLamp)>,
}

/// A face on the image.
#[derive(Clone, Debug)]
pub struct Polygon {
    /// Corners, px.
    corners: Vec<Point2<f64>>,
    /// Colour.
    pub colour: Bgr,
    depth_m: f64,
}

impl Solids {
    /// Those of a track.
    pub fn of(track: &Track) -> Self {
        let mut faces: Vec<Face> = track.boxes.iter().flat_map(|block| boxed(block, 0.0)).collect();
        for wall in &track.walls {
            faces.push(upright([wall.from, wall.to], [0.0, wall.height_m], wall.colour, true));
        }
        faces.extend(track.lights.iter().flat_map(post_and_housing));
        let lamps = track.lights.iter().enumerate();
        let lamps = lamps.flat_map(|(index, light)| light.lamps().map(|lamp| (index, lamp))).collect();
        Self { faces, lamps }
    }

    /// Whether all of them are grey.
    pub fn is_grey(&self) -> bool {
        let grey = |face: &Face| face.colour[0] == face.colour[1] && face.colour[1] == face.colour[2];
        self.lamps.is_empty() && self.faces.iter().all(grey)
    }

    /// What can be seen from a pose, the farthest first.
    pub fn visible(&self, model: &CameraModel, pose: Pose, scene: Scene<'_>) -> Vec<Polygon> {
        let body_from_map = Isometry2::new([pose.x_m, pose.y_m].into(), pose.yaw_rad).inverse();
        let placed: Vec<Face> = scene.blocks.iter().flat_map(|block| boxed(block, 0.0)).collect();
        let mut polygons: Vec<Polygon> =
            self.faces.iter().chain(&placed).filter_map(|face| project(face, model, &body_from_map)).collect();
        for (light, lamp) in &self.lamps {
            let lit = scene.shown.get(*light).is_some_and(|shown| *shown == Some(lamp.colour));
            let discs = discs(lamp, lit).into_iter().filter_map(|face| project(&face, model, &body_from_map));
            polygons.extend(discs.map(|disc| Polygon { depth_m: disc.depth_m - LAMP_NEARER_M, ..disc }));
        }
        // A core is as far away as its halo: stable, it stays behind it in the order, which is before it in the image.
        polygons.sort_by(|a, b| b.depth_m.total_cmp(&a.depth_m));
        polygons
    }
}

/// The sides and the top of a box that begins at `bottom_m` above the floor.
fn boxed(block: &Block, bottom_m: f64) -> Vec<Face> {
    let (corners, top_m) = (block.corners(), bottom_m + block.height_m);
    let side = |i: usize| upright([corners[i], corners[(i + 1) % 4]], [bottom_m, top_m], block.colour, false);
    let top = corners.map(|corner| Point3::new(corner.x, corner.y, top_m)).to_vec();
    (0..4).map(side).chain([face(top, block.colour, false)]).collect()
}

fn post_and_housing(light: &TrafficLight) -> Vec<Face> {
    let [across_m, up_m, along_m] = traffic_light::HOUSING_M;
    let bottom_m = (light.height_m - up_m / 2.0).max(0.0);
    let block = |length_m, width_m, height_m| Block {
        pose: light.post,
        length_m,
        width_m,
        height_m,
        colour: traffic_light::HOUSING,
    };
    let mut faces = boxed(&block(along_m, across_m, up_m), bottom_m);
    faces.extend(boxed(&block(traffic_light::POST_M, traffic_light::POST_M, bottom_m), 0.0));
    faces
}

/// A lamp as flat discs, the largest first. They shine: their colour is that of the light, from wherever it is looked at.
fn discs(lamp: &HungLamp, lit: bool) -> Vec<Face> {
    let (halo, core) = lamp.colours(lit);
    let disc = |radius_m: f64, colour| Face { corners: lamp.disc(radius_m), two_sided: false, colour };
    let radius_m = traffic_light::LAMP_RADIUS_M;
    let core = core.map(|colour| disc(radius_m * traffic_light::CORE, colour));
    std::iter::once(disc(radius_m, halo)).chain(core).collect()
}

fn upright([from, to]: [Point2<f64>; 2], [low_m, high_m]: [f64; 2], colour: Bgr, two_sided: bool) -> Face {
    let at = |point: Point2<f64>, z_m: f64| Point3::new(point.x, point.y, z_m);
    face(vec![at(from, low_m), at(to, low_m), at(to, high_m), at(from, high_m)], colour, two_sided)
}

fn face(corners: Vec<Point3<f64>>, colour: Bgr, two_sided: bool) -> Face {
    let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[1]));
    let normal = normal.try_normalize(1e-12).unwrap_or_else(Vector3::z);
    let facing = normal.dot(&Vector3::from(LIGHT));
    let light = 0.75 + 0.25 * if two_sided { facing.abs() } else { facing };
    Face { corners, two_sided, colour: colour.map(|value| (f64::from(value) * light) as u8) }
}

fn project(face: &Face, model: &CameraModel, body_from_map: &Isometry2<f64>) -> Option<Polygon> {
    let in_camera = |point: &Point3<f64>| {
        let flat = body_from_map * point.xy();
        model.from_body(Point3::new(flat.x, flat.y, point.z))
    };
    let corners: Vec<Point3<f64>> = face.corners.iter().map(in_camera).collect();
    let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[1]));
    // The camera's frame is a rotation of the map's, so the sense of the corners stays: seen from outside, the normal looks back.
    let faces_away = normal.dot(&corners[0].coords) >= 0.0;
    if faces_away && !face.two_sided {
        return None;
    }
    let clipped = clip(&corners);
    if clipped.len() < 3 {
        return None;
    }
    let depth_m = corners.iter().map(|corner| corner.coords.norm()).sum::<f64>() / corners.len() as f64;
    Some(Polygon {
        corners: clipped.iter().map(|corner| model.project(*corner)).collect(),
        colour: face.colour,
        depth_m,
    })
}

/// The part of a polygon before the near plane (Sutherland and Hodgman 1974).
fn clip(corners: &[Point3<f64>]) -> Vec<Point3<f64>> {
    let mut kept = Vec::with_capacity(corners.len() + 1);
    for (i, from) in corners.iter().enumerate() {
        let to = corners[(i + 1) % corners.len()];
        if from.z >= NEAR_M {
            kept.push(*from);
        }
        if (from.z >= NEAR_M) != (to.z >= NEAR_M) {
            kept.push(from + (to - from) * ((NEAR_M - from.z) / (to.z - from.z)));
        }
    }
    kept
}

impl Polygon {
    /// Calls `span` with each row that it covers and the columns in it.
    pub fn rows(&self, width: usize, height: usize, mut span: impl FnMut(usize, std::ops::Range<usize>)) {
        let (top, bottom) = self.corners.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(top, bottom), corner| {
            (top.min(corner.y), bottom.max(corner.y))
        });
        for row in top.ceil().max(0.0) as usize..(bottom.floor() + 1.0).clamp(0.0, height as f64) as usize {
            if let Some((left, right)) = self.crossings(row as f64) {
                let start = left.ceil().clamp(0.0, width as f64) as usize;
                let end = (right.floor() + 1.0).clamp(0.0, width as f64) as usize;
                if start < end {
                    span(row, start..end);
                }
            }
        }
    }

    fn crossings(&self, row: f64) -> Option<(f64, f64)> {
        let mut found: Option<(f64, f64)> = None;
        for (i, a) in self.corners.iter().enumerate() {
            let b = self.corners[(i + 1) % self.corners.len()];
            if (a.y <= row) != (b.y <= row) {
                let x = a.x + (b.x - a.x) * (row - a.y) / (b.y - a.y);
                found = Some(found.map_or((x, x), |(left, right)| (left.min(x), right.max(x))));
            }
        }
        found
    }
}
