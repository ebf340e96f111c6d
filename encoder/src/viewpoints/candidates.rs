//! The kind of a scene, and cameras in its free places.

use std::f64::consts::{PI, TAU};

use glam::{DAffine3, DVec3};

use super::looks::{look_along, look_at};
use super::plan::SceneKind;
use super::space::{Space, VOXEL, WIDTH};

/// Most candidates; each costs a small drawing.
pub(super) const MOST: usize = 600;
const N_HEADINGS: usize = 8;
/// Heights of cameras in a room, as shares of its height, and how far they look down, radians.
const INDOOR: [(f64, f64); 2] = [(0.4, 0.05), (0.6, 0.25)];
/// Free distance around a camera, as a share of the room's height.
const CLEARANCE: f64 = 0.12;
/// Heights of cameras above the ground, as shares of the scene's width, and how far they look down, radians.
const OUTDOOR: [(f64, f64); 3] = [(0.03, 0.05), (0.06, 0.15), (0.12, 0.4)];
/// Rings around an object: elevation, radians, and distance as a share of the one at which it fills the image.
const RINGS: [(f64, f64); 5] = [(0.1, 1.0), (0.1, 0.6), (0.45, 1.0), (0.45, 0.6), (0.95, 1.0)];
const N_AROUND: usize = 24;
/// Least share, of the columns with ground, that have something overhead above a gap in an indoor scene. A yard has 11
/// %, a drone scene 23 %.
const MIN_OVERHEAD: f64 = 0.5;

/// Rooms have something overhead.
pub(super) fn kind_of(space: &Space) -> SceneKind {
    let ground = 0.6 * space.half.z - space.half.z;
    let gap = 0.8 * space.half.z;
    let (mut n_ground, mut n_overhead) = (0, 0);
    for (x, y) in space.lattice(2.0 * VOXEL) {
        let column: Vec<f64> = space.column(x, y).collect();
        if column.first().is_some_and(|low| *low < ground) {
            n_ground += 1;
            n_overhead += u32::from(column.windows(2).any(|pair| pair[1] - pair[0] > gap));
        }
    }
    let is_indoor = f64::from(n_overhead) >= MIN_OVERHEAD * f64::from(1.max(n_ground));
    if is_indoor { SceneKind::Indoor } else { SceneKind::Outdoor }
}

pub(super) fn of(kind: SceneKind, space: &Space) -> Vec<DAffine3> {
    match kind {
        SceneKind::Indoor => standing(space, INDOOR.len(), indoor_places),
        SceneKind::Outdoor => standing(space, OUTDOOR.len(), outdoor_places),
        SceneKind::Object => rings(space),
    }
}

/// Cameras with all headings at the places of the finest lattice that has few enough.
fn standing(
    space: &Space,
    n_heights: usize,
    places_of: fn(&Space, f64, f64) -> Vec<(DVec3, f64)>,
) -> Vec<DAffine3> {
    let area = 4.0 * space.half.x * space.half.y;
    let mut step = (area * (n_heights * N_HEADINGS) as f64 / (2.0 * MOST as f64)).sqrt().max(2.0 * VOXEL);
    let places = loop {
        let places: Vec<(DVec3, f64)> =
            space.lattice(step).flat_map(|(x, y)| places_of(space, x, y)).collect();
        if places.len() * N_HEADINGS <= MOST {
            break places;
        }
        step *= 1.1;
    };
    let headings = places.into_iter().enumerate().flat_map(|(number, (at, down))| {
        (0..N_HEADINGS).map(move |heading| {
            // Every second place looks between the headings of the others.
            let angle = TAU * (heading as f64 + 0.5 * (number % 2) as f64) / N_HEADINGS as f64;
            look_along(at, DVec3::new(angle.cos() * down.cos(), angle.sin() * down.cos(), -down.sin()))
        })
    });
    headings.collect()
}

/// Free places between floor and ceiling, with how far cameras look down.
fn indoor_places(space: &Space, x: f64, y: f64) -> Vec<(DVec3, f64)> {
    let height = 2.0 * space.half.z;
    let places =
        INDOOR.into_iter().map(|(part, down)| (DVec3::new(x, y, part * height - space.half.z), down));
    let is_in_room = |at: DVec3| {
        let above = space.column(x, y).next_back().is_some_and(|high| high > at.z + 0.2 * height);
        let below = space.column(x, y).next().is_some_and(|low| low < at.z);
        above && below
    };
    places.filter(|(at, _)| is_in_room(*at) && space.is_clear(*at, (CLEARANCE * height).max(VOXEL))).collect()
}

/// Free places above the ground, with how far cameras look down.
fn outdoor_places(space: &Space, x: f64, y: f64) -> Vec<(DVec3, f64)> {
    let Some(ground) = space.column(x, y).next() else { return Vec::new() };
    let places =
        OUTDOOR.into_iter().map(|(part, down)| (DVec3::new(x, y, ground + part * WIDTH), down, part));
    let clear = places.filter(|(at, _, part)| space.is_clear(*at, 0.5 * part.min(0.1) * WIDTH));
    clear.map(|(at, down, _)| (at, down)).collect()
}

/// Cameras around an object that look at its middle and, from near, at its upper and lower part.
fn rings(space: &Space) -> Vec<DAffine3> {
    let fills = space.half.length() / (PI / 8.0).sin();
    let around = RINGS.into_iter().flat_map(|(elevation, part)| {
        let heights = if part < 1.0 { vec![-0.5, 0.0, 0.5] } else { vec![0.0] };
        heights.into_iter().flat_map(move |height| (0..N_AROUND).map(move |i| (elevation, part, height, i)))
    });
    let camera = |(elevation, part, height, i): (f64, f64, f64, usize)| {
        let angle = TAU * i as f64 / N_AROUND as f64;
        let direction =
            DVec3::new(angle.cos() * elevation.cos(), angle.sin() * elevation.cos(), elevation.sin());
        let target = DVec3::new(0.0, 0.0, height * space.half.z);
        look_at(target + direction * fills * part, target)
    };
    around.map(camera).collect()
}
