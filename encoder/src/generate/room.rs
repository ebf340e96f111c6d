//! The room: what furniture there is, what it is made of, and where it stands.

use glam::DVec3;
use serde::Serialize;
use slag_common::Gaussians;

use super::solid::{Part, Random, Shape, cover};

/// Width, depth and height of the room; a corner of the floor is the origin.
pub const SIZE_M: DVec3 = DVec3::new(7.0, 5.5, 2.6);

/// Distance between surface Gaussians of furniture and of the room itself.
const FURNITURE_SPACING_M: f64 = 0.03;
const ROOM_SPACING_M: f64 = 0.06;

const FLOOR_RGB: [f64; 3] = [0.62, 0.62, 0.62];
const WALL_RGB: [f64; 3] = [0.92, 0.92, 0.92];

/// An object as it truly is.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrueObject {
    /// What it is.
    pub name: &'static str,
    /// Its main colour, one of the eleven basic colour terms.
    pub colour: &'static str,
    /// Smallest corner of the box around it, metres.
    pub box_min: DVec3,
    /// Largest corner.
    pub box_max: DVec3,
    /// Its Gaussians.
    pub n_gaussians: usize,
}

struct Furniture {
    name: &'static str,
    colour: &'static str,
    parts: Vec<Part>,
}

/// Places along the walls: x, y, yaw in degrees (0 faces +y).
const PLACES: [[f64; 3]; 8] = [
    [1.5, 0.65, 0.0],
    [3.6, 0.65, 0.0],
    [5.6, 0.65, 0.0],
    [6.35, 2.75, 90.0],
    [5.5, 4.85, 180.0],
    [3.5, 4.85, 180.0],
    [1.5, 4.85, 180.0],
    [0.65, 2.75, -90.0],
];

/// Builds the room of a seed: the same furniture, shuffled over the places and jittered.
pub fn build(seed: u64) -> (Gaussians, Vec<TrueObject>) {
    let mut random = Random::new(seed);
    let mut scene = Gaussians::default();
    for part in shell() {
        cover(&mut scene, &part, DVec3::ZERO, 0.0, ROOM_SPACING_M, &mut random);
    }
    let mut furniture = furniture();
    for i in (1..furniture.len()).rev() {
        let j = ((random.signed() + 1.0) / 2.0 * (i + 1) as f64) as usize;
        furniture.swap(i, j.min(i));
    }
    let mut objects = Vec::new();
    for (piece, [x, y, yaw_deg]) in furniture.iter().zip(PLACES) {
        let position = DVec3::new(x + 0.1 * random.signed(), y + 0.05 * random.signed(), 0.0);
        let yaw_rad = (yaw_deg + 6.0 * random.signed()).to_radians();
        let first = scene.len();
        for part in &piece.parts {
            cover(&mut scene, part, position, yaw_rad, FURNITURE_SPACING_M, &mut random);
        }
        let means = &scene.means_in_world[first..];
        objects.push(TrueObject {
            name: piece.name,
            colour: piece.colour,
            box_min: means.iter().copied().fold(DVec3::INFINITY, DVec3::min),
            box_max: means.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max),
            n_gaussians: means.len(),
        });
    }
    (scene, objects)
}

/// Floor, ceiling and walls: thin boxes.
fn shell() -> Vec<Part> {
    let half = SIZE_M / 2.0;
    let slab = |centre: DVec3, half: DVec3, rgb| Part { shape: Shape::Box(half), centre, rgb };
    let thin = 0.01;
    vec![
        slab(DVec3::new(half.x, half.y, -thin), DVec3::new(half.x, half.y, thin), FLOOR_RGB),
        slab(DVec3::new(half.x, half.y, SIZE_M.z + thin), DVec3::new(half.x, half.y, thin), WALL_RGB),
        slab(DVec3::new(half.x, -thin, half.z), DVec3::new(half.x, thin, half.z), WALL_RGB),
        slab(DVec3::new(half.x, SIZE_M.y + thin, half.z), DVec3::new(half.x, thin, half.z), WALL_RGB),
        slab(DVec3::new(-thin, half.y, half.z), DVec3::new(thin, half.y, half.z), WALL_RGB),
        slab(DVec3::new(SIZE_M.x + thin, half.y, half.z), DVec3::new(thin, half.y, half.z), WALL_RGB),
    ]
}

/// Returns a box part by its centre and full size, metres.
fn cuboid(centre: [f64; 3], size: [f64; 3], rgb: [f64; 3]) -> Part {
    Part { shape: Shape::Box(DVec3::from(size) / 2.0), centre: centre.into(), rgb }
}

fn cylinder(centre: [f64; 3], radius_m: f64, height_m: f64, rgb: [f64; 3]) -> Part {
    Part { shape: Shape::Cylinder { radius_m, half_height_m: height_m / 2.0 }, centre: centre.into(), rgb }
}

fn ellipsoid(centre: [f64; 3], half: [f64; 3], rgb: [f64; 3]) -> Part {
    Part { shape: Shape::Ellipsoid(half.into()), centre: centre.into(), rgb }
}

/// Returns four legs under the corners of a top.
fn legs(half_x: f64, half_y: f64, height_m: f64, rgb: [f64; 3]) -> impl Iterator<Item = Part> {
    let corners = [[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]];
    corners
        .into_iter()
        .map(move |[x, y]| cuboid([x * half_x, y * half_y, height_m / 2.0], [0.05, 0.05, height_m], rgb))
}

fn furniture() -> Vec<Furniture> {
    const BLUE: [f64; 3] = [0.10, 0.22, 0.80];
    const RED: [f64; 3] = [0.82, 0.08, 0.08];
    const BROWN: [f64; 3] = [0.42, 0.24, 0.10];
    const ORANGE: [f64; 3] = [0.98, 0.50, 0.05];
    const YELLOW: [f64; 3] = [0.97, 0.88, 0.08];
    const GREEN: [f64; 3] = [0.10, 0.58, 0.15];
    const PURPLE: [f64; 3] = [0.48, 0.12, 0.62];
    const BLACK: [f64; 3] = [0.03, 0.03, 0.03];
    let seat = |width_m: f64, rgb| {
        vec![
            cuboid([0.0, 0.0, 0.22], [width_m, 0.80, 0.40], rgb),
            cuboid([0.0, -0.33, 0.62], [width_m, 0.18, 0.48], rgb),
            cuboid([-width_m / 2.0 + 0.08, 0.05, 0.5], [0.16, 0.7, 0.24], rgb),
            cuboid([width_m / 2.0 - 0.08, 0.05, 0.5], [0.16, 0.7, 0.24], rgb),
        ]
    };
    let chair = || {
        let back = cuboid([0.0, -0.21, 0.72], [0.44, 0.05, 0.52], ORANGE);
        let top = cuboid([0.0, 0.0, 0.45], [0.46, 0.46, 0.06], ORANGE);
        legs(0.2, 0.2, 0.43, ORANGE).chain([top, back]).collect::<Vec<_>>()
    };
    let bookshelf = || {
        let boards = (0..5).map(|i| cuboid([0.0, 0.0, 0.03 + 0.44 * f64::from(i)], [0.9, 0.3, 0.04], PURPLE));
        let sides = [-0.45, 0.45].map(|x| cuboid([x, 0.0, 0.9], [0.04, 0.3, 1.8], PURPLE));
        let back = cuboid([0.0, -0.14, 0.9], [0.9, 0.02, 1.8], PURPLE);
        boards.chain(sides).chain([back]).collect::<Vec<_>>()
    };
    let table = || {
        let top = cuboid([0.0, 0.0, 0.74], [1.3, 0.75, 0.06], BROWN);
        legs(0.58, 0.31, 0.71, BROWN).chain([top]).collect::<Vec<_>>()
    };
    vec![
        Furniture { name: "sofa", colour: "blue", parts: seat(1.7, BLUE) },
        Furniture { name: "armchair", colour: "red", parts: seat(0.9, RED) },
        Furniture { name: "table", colour: "brown", parts: table() },
        Furniture { name: "chair", colour: "orange", parts: chair() },
        Furniture {
            name: "floor lamp",
            colour: "yellow",
            parts: vec![
                cylinder([0.0, 0.0, 0.02], 0.16, 0.04, YELLOW),
                cylinder([0.0, 0.0, 0.65], 0.03, 1.25, YELLOW),
                cylinder([0.0, 0.0, 1.45], 0.25, 0.40, YELLOW),
            ],
        },
        Furniture {
            name: "plant",
            colour: "green",
            parts: vec![
                cylinder([0.0, 0.0, 0.20], 0.20, 0.40, GREEN),
                ellipsoid([0.0, 0.0, 0.80], [0.38, 0.38, 0.48], GREEN),
            ],
        },
        Furniture { name: "bookshelf", colour: "purple", parts: bookshelf() },
        Furniture {
            name: "television",
            colour: "black",
            parts: vec![
                cuboid([0.0, 0.0, 0.95], [1.25, 0.06, 0.72], BLACK),
                cuboid([0.0, 0.0, 0.30], [0.12, 0.06, 0.58], BLACK),
                cuboid([0.0, 0.0, 0.02], [0.55, 0.28, 0.03], BLACK),
            ],
        },
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn furniture_stands_in_the_room_and_apart() {
        for seed in 0..20 {
            let (scene, objects) = build(seed);
            assert!((0..scene.len()).all(|i| scene.is_usable(i)));
            for (i, a) in objects.iter().enumerate() {
                assert!(
                    a.box_min.cmpge(DVec3::splat(-0.02)).all() && a.box_max.cmple(SIZE_M).all(),
                    "{seed} {a:?}"
                );
                for b in &objects[..i] {
                    let apart = a.box_min.cmpgt(b.box_max).any() || b.box_min.cmpgt(a.box_max).any();
                    assert!(apart, "seed {seed}: {} and {} overlap", a.name, b.name);
                }
            }
        }
        assert_eq!(build(7), build(7));
        assert_ne!(build(7).1, build(8).1);
    }
}
