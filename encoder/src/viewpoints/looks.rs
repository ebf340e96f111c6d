//! Where drawings could be made, and a small drawing of each: can it be trusted, and which Gaussians does it show?

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

use glam::{DAffine3, DMat3, DVec3};
use slag_common::Intrinsics;

use super::plan::{SceneKind, Verdict};
use super::space::{Space, VOXEL, WIDTH};
use crate::masks::RegionMap;
use crate::raster::{self, LoadedScene, RasterError, RasterView, RegionWeight};

const SIZE_PX: [u32; 2] = [40, 30];
/// Tangent of half the horizontal field of view, 60 degrees, as of a phone's main camera.
const HALF_WIDTH: f64 = 0.577_350_269;
/// A pixel of lower opacity is a hole.
const MIN_COVERED: f64 = 0.5;
/// Relative difference of expected and median depth from which a pixel is hazy.
const HAZY: f64 = 0.15;
/// A pixel of lower depth is near.
const NEAR: f64 = 0.035 * WIDTH;
/// Standard deviation on the screen of a large Gaussian: 24 px of a photo 640 px wide.
const LARGE_PX: f64 = 24.0 / 640.0 * SIZE_PX[0] as f64;
/// Least weight of a seen Gaussian, pixels of the drawing: 36 px of a photo 800 px wide.
const MIN_WEIGHT: f32 = 0.09;
/// Sides from which a Gaussian can be seen, around the vertical; as many again from steeply above.
const N_SIDES: u8 = 8;
/// Sine of the elevation from which a camera is steeply above: 37 degrees.
const STEEP: f64 = 0.6;
/// Sine of the angle below the horizon up to which a camera looks at things from beside: 15 degrees.
const LEVEL: f64 = 0.26;
/// Bytes of a look: eight per Gaussian, about three Gaussians per pixel.
pub(super) const LOOK_BYTES: u64 = 8 * 3 * (SIZE_PX[0] * SIZE_PX[1]) as u64;

pub(super) struct Look {
    /// From the planner's axes.
    pub(super) camera: DAffine3,
    pub(super) verdict: Verdict,
    /// What it is preferred by, among views that show as much.
    pub(super) preference: u64,
    /// Gaussians, and the side from which they are seen.
    pub(super) seen: Vec<(u32, u8)>,
}

/// An upright camera at a place that looks along a direction.
pub(super) fn look_along(eye: DVec3, direction: DVec3) -> DAffine3 {
    let forward = direction.normalize();
    let right = forward.cross(DVec3::Z).try_normalize().unwrap_or(DVec3::X);
    let camera_from_plan = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    DAffine3 { matrix3: camera_from_plan, translation: -(camera_from_plan * eye) }
}

pub(super) fn look_at(eye: DVec3, target: DVec3) -> DAffine3 {
    look_along(eye, target - eye)
}

pub(super) fn pinhole(size_px: [u32; 2]) -> Intrinsics {
    raster::pinhole(size_px, 0.5 * f64::from(size_px[0]) / HALF_WIDTH)
}

/// Draws each Gaussian's weight at each pixel, and judges the view.
pub(super) fn look(
    loaded: &dyn LoadedScene,
    space: &Space,
    camera: DAffine3,
    kind: SceneKind,
) -> Result<Look, RasterError> {
    let [width_px, height_px] = SIZE_PX;
    let n_px = width_px * height_px;
    let regions = RegionMap { width_px, height_px, region_of_pixel: (0..n_px).collect(), n_regions: n_px };
    let intrinsics = pinhole(SIZE_PX);
    let view = RasterView { camera_from_world: camera, intrinsics };
    let weights = loaded.weights(&view, &regions)?;
    let eye = camera.inverse().translation;
    let (mut large, mut total) = (0.0, 0.0);
    let mut seen = Vec::new();
    // Gaussians with their depths, from near to far.
    let mut layers = Vec::new();
    // Weight of each pixel, and its weighted depth.
    let mut sums = vec![(0.0, 0.0); n_px as usize];
    for entries in weights.entries.chunk_by(|a, b| a.gaussian == b.gaussian) {
        let gaussian = entries[0].gaussian as usize;
        let mean = space.scene.means_in_world[gaussian];
        let depth = camera.transform_point3(mean).z;
        let sum: f32 = entries.iter().map(|entry| entry.weight).sum();
        let scale = f64::from(space.scene.scales[gaussian].into_iter().fold(0.0, f32::max) / space.grown);
        total += f64::from(sum);
        if scale * intrinsics.focal_x_px > LARGE_PX * depth {
            large += f64::from(sum);
        }
        if sum >= MIN_WEIGHT {
            seen.push((entries[0].gaussian, side(eye - mean)));
        }
        for entry in entries {
            let (weight, weighted) = &mut sums[entry.region as usize];
            *weight += f64::from(entry.weight);
            *weighted += f64::from(entry.weight) * depth;
        }
        layers.push((depth, entries));
    }
    layers.sort_by(|a, b| a.0.total_cmp(&b.0));
    let near = if kind == SceneKind::Object { 0.0 } else { NEAR };
    let [n_covered, n_near, n_hazy] = count_pixels(&layers, &sums, near);
    let share = |n: u32, of: u32| n as f32 / of.max(1) as f32;
    let verdict = Verdict {
        holes: 1.0 - share(n_covered, n_px),
        near: share(n_near, n_covered),
        haze: share(n_hazy, n_covered),
        large: (large / f64::max(total, f64::MIN_POSITIVE)) as f32,
    };
    if verdict.fault(kind).is_some() {
        seen = Vec::new();
    }
    Ok(Look { camera, verdict, preference: preference(kind, camera), seen })
}

/// Counts pixels that are no holes, and of those the near and the hazy ones, by median depth. `layers`: Gaussians from
/// near to far with their depths; `sums`: weight of each pixel, and its weighted depth.
fn count_pixels(layers: &[(f64, &[RegionWeight])], sums: &[(f64, f64)], near: f64) -> [u32; 3] {
    let [mut n_covered, mut n_near, mut n_hazy] = [0; 3];
    let mut nearer = vec![0.0; sums.len()];
    for (depth, entries) in layers {
        for entry in *entries {
            let ((weight, weighted), nearer) =
                (sums[entry.region as usize], &mut nearer[entry.region as usize]);
            let is_before = *nearer < 0.5 * weight;
            *nearer += f64::from(entry.weight);
            if weight >= MIN_COVERED && is_before && *nearer >= 0.5 * weight {
                n_covered += 1;
                n_near += u32::from(*depth < near);
                n_hazy += u32::from((weighted / weight - depth).abs() > HAZY * depth);
            }
        }
    }
    [n_covered, n_near, n_hazy]
}

/// Outdoors, image encoders know things from beside better than from above; few low views are clear enough to be good.
fn preference(kind: SceneKind, camera: DAffine3) -> u64 {
    let forward = camera.matrix3.row(2);
    if kind == SceneKind::Outdoor && forward.z > -LEVEL { 2 } else { 1 }
}

/// Side from which a Gaussian is seen, by the direction to the camera.
fn side(towards: DVec3) -> u8 {
    let turns = towards.y.atan2(towards.x) / TAU + 0.5;
    let around = ((turns * f64::from(N_SIDES)) as u8).min(N_SIDES - 1);
    if towards.z > STEEP * towards.length() { N_SIDES + around } else { around }
}

/// Most candidates; each costs a small drawing.
pub(super) const MOST: usize = 600;
const N_HEADINGS: usize = 8;
/// Heights of cameras in a room, as shares of its height, and how far they look down, radians.
const INDOOR: [(f64, f64); 2] = [(0.4, 0.05), (0.6, 0.25)];
/// Free distance around a camera, as a share of the room's height.
const CLEARANCE: f64 = 0.12;
/// Least height of a storey, as a share of the house's.
const MIN_STOREY: f64 = 0.2;
/// Heights of cameras above the ground, as shares of the scene's width, and how far they look down, radians.
const OUTDOOR: [(f64, f64); 4] = [(0.03, 0.05), (0.06, 0.15), (0.12, 0.4), (0.25, 0.8)];
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

/// Whether rooms hang from their floors: more things stand on floors than hang from ceilings.
pub(super) fn is_upside_down(space: &Space) -> bool {
    let number = |z: f64| (z / VOXEL).round() as i64;
    let columns = space.lattice(2.0 * VOXEL).map(|(x, y)| space.column(x, y).map(number).collect());
    let least = number(MIN_STOREY * 2.0 * space.half.z);
    let gaps = columns.flat_map(|column: Vec<i64>| {
        let pairs: Vec<[i64; 2]> = column.windows(2).map(|pair| [pair[0], pair[1]]).collect();
        pairs.into_iter().filter(|[low, high]| high - low > least)
    });
    let gaps: Vec<[i64; 2]> = gaps.collect();
    let mut heights: Vec<f64> = gaps.iter().map(|[low, high]| (high - low) as f64).collect();
    let off = (0.1 * slag_math::stats::median(&mut heights).unwrap_or(0.0)) as i64;
    // Columns that end above the floor below them; for ceilings, with heights negated.
    let n_off = |ends: Vec<i64>| {
        let mut n_at = BTreeMap::<i64, usize>::new();
        ends.iter().for_each(|end| *n_at.entry(*end).or_default() += 1);
        let most = n_at.values().max().copied().unwrap_or(0);
        n_at.retain(|_, n| 10 * *n >= 3 * most);
        let is_off =
            |end: &&i64| n_at.range(..=**end).next_back().is_some_and(|(floor, _)| **end - floor > off);
        ends.iter().filter(is_off).count()
    };
    n_off(gaps.iter().map(|[low, _]| *low).collect()) < n_off(gaps.iter().map(|[_, high]| -high).collect())
}

pub(super) fn of(kind: SceneKind, space: &Space) -> Vec<DAffine3> {
    match kind {
        SceneKind::Indoor => standing(space, INDOOR.len(), indoor_places),
        SceneKind::Outdoor => standing(space, OUTDOOR.len(), outdoor_places),
        SceneKind::Object => rings(space),
    }
}

/// Cameras between the floors of a house, where half its height is a floor.
pub(super) fn of_storeys(space: &Space) -> Vec<DAffine3> {
    standing(space, 2 * INDOOR.len(), storey_places)
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

/// Free places between what lies above each other, with how far cameras look down.
fn storey_places(space: &Space, x: f64, y: f64) -> Vec<(DVec3, f64)> {
    let column: Vec<f64> = space.column(x, y).collect();
    let storeys = column.windows(2).map(|pair| (pair[0], pair[1] - pair[0]));
    let storeys = storeys.filter(|(_, height)| *height > MIN_STOREY * 2.0 * space.half.z);
    let places = storeys.flat_map(|(floor, height)| {
        INDOOR.map(|(part, down)| (DVec3::new(x, y, floor + part * height), down, height))
    });
    let clear = places.filter(|(at, _, height)| space.is_clear(*at, (CLEARANCE * height).max(VOXEL)));
    clear.map(|(at, down, _)| (at, down)).collect()
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
