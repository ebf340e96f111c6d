//! A small drawing of a candidate: can it be trusted, and which Gaussians does it show?

use std::fmt;

use glam::{DAffine3, DMat3, DVec3};
use serde::Serialize;
use slag_common::{Distortion, Gaussians, Intrinsics};

use super::SceneKind;
use super::space::{Space, WIDTH};
use crate::masks::RegionMap;
use crate::raster::{LoadedScene, RasterError, RasterView, Rasterizer, WeightKind};

/// Size of the drawings, pixels.
const SIZE_PX: [u32; 2] = [80, 60];
/// Tangent of half the horizontal field of view, 60 degrees: that of a phone's main camera.
pub(super) const HALF_WIDTH: f64 = 0.577_350_269;
/// Opacity below which a pixel is a hole.
pub(super) const MIN_COVERED: f32 = 0.5;
/// Difference of expected and median depth, relative to the latter, from which a pixel is hazy.
const HAZY: f64 = 0.15;
/// Depth below which a pixel is near.
const NEAR: f64 = 0.035 * WIDTH;
/// Standard deviation on the screen from which a Gaussian is large: 24 px of a photo 640 px wide.
const LARGE_PX: f64 = 24.0 / 640.0 * SIZE_PX[0] as f64;
/// Weight of a Gaussian that is seen, pixels of the drawing.
const MIN_WEIGHT: f32 = 0.05;
/// Sides from which a Gaussian can be seen, around the vertical.
pub(super) const N_SIDES: usize = 8;
/// Bytes of what a candidate shows: eight a Gaussian, of which a pixel shows few.
pub(super) const LOOK_BYTES: u64 = 8 * 3 * (SIZE_PX[0] * SIZE_PX[1]) as u64;
/// Most of each that a view may have, 0 to 1.
const MAX_HOLES: f32 = 0.1;
const MAX_NEAR: f32 = 0.2;
const MAX_HAZE: f32 = 0.15;
const MAX_LARGE: f32 = 0.7;
/// An object need not fill the image.
const MAX_HOLES_OF_OBJECT: f32 = 0.97;

/// How far a drawing can be trusted; shares of 0 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Verdict {
    /// Pixels through which nothing is seen.
    pub holes: f32,
    /// Pixels whose surface is too near to be sharp.
    pub near: f32,
    /// Pixels whose expected and median depths differ: no clear surface.
    pub haze: f32,
    /// Weight of Gaussians that are large on the screen: no detail.
    pub large: f32,
}

/// Why a view cannot be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    Holes,
    Near,
    Haze,
    Large,
}

impl Fault {
    pub(super) const ALL: [Self; 4] = [Self::Holes, Self::Near, Self::Haze, Self::Large];
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Holes => "look into holes",
            Self::Near => "are too near to something",
            Self::Haze => "look through haze",
            Self::Large => "show no detail",
        })
    }
}

impl Verdict {
    /// Returns why a view is not to be used; `None` if it is good.
    pub fn fault(&self, kind: SceneKind) -> Option<Fault> {
        let holes = if kind == SceneKind::Object { MAX_HOLES_OF_OBJECT } else { MAX_HOLES };
        let limits = [
            (self.holes, holes, Fault::Holes),
            (self.near, MAX_NEAR, Fault::Near),
            (self.haze, MAX_HAZE, Fault::Haze),
            (self.large, MAX_LARGE, Fault::Large),
        ];
        limits.into_iter().find(|(found, limit, _)| found > limit).map(|(.., fault)| fault)
    }
}

/// What a candidate shows.
pub(super) struct Look {
    /// Camera from the planner's axes.
    pub(super) camera: DAffine3,
    pub(super) verdict: Verdict,
    /// Gaussians that are seen, and from which side.
    pub(super) seen: Vec<(u32, u8)>,
}

/// Returns the camera at a place that looks along a direction, upright.
pub(super) fn look_along(eye: DVec3, direction: DVec3) -> DAffine3 {
    let forward = direction.normalize();
    let right = forward.cross(DVec3::Z).try_normalize().unwrap_or(DVec3::X);
    let camera_from_plan = DMat3::from_cols(right, forward.cross(right), forward).transpose();
    DAffine3 { matrix3: camera_from_plan, translation: -(camera_from_plan * eye) }
}

pub(super) fn look_at(eye: DVec3, target: DVec3) -> DAffine3 {
    look_along(eye, target - eye)
}

/// Returns an ideal camera with the planner's field of view.
pub(super) fn pinhole(width_px: u32, height_px: u32) -> Intrinsics {
    let focal_px = 0.5 * f64::from(width_px) / HALF_WIDTH;
    Intrinsics {
        width_px,
        height_px,
        focal_x_px: focal_px,
        focal_y_px: focal_px,
        centre_x_px: 0.5 * f64::from(width_px),
        centre_y_px: 0.5 * f64::from(height_px),
        distortion: Distortion::None,
    }
}

/// A Gaussian at a pixel.
#[derive(Clone, Copy)]
struct Layer {
    depth: f64,
    weight: f64,
}

/// Draws the weight of each Gaussian at each pixel, and judges it.
pub(super) fn look(
    loaded: &dyn LoadedScene,
    scene: &Gaussians,
    camera: DAffine3,
    kind: SceneKind,
) -> Result<Look, RasterError> {
    let [width_px, height_px] = SIZE_PX;
    let n_px = width_px * height_px;
    let regions = RegionMap { width_px, height_px, region_of_pixel: (0..n_px).collect(), n_regions: n_px };
    let intrinsics = pinhole(width_px, height_px);
    let view = RasterView { camera_from_world: camera, intrinsics };
    let weights = loaded.weights(&view, &regions, WeightKind::Blend)?;
    let eye = camera.inverse().translation;
    let mut of_pixel: Vec<Vec<Layer>> = vec![Vec::new(); n_px as usize];
    let (mut large, mut total) = (0.0, 0.0);
    let mut seen = Vec::new();
    for entries in weights.entries.chunk_by(|a, b| a.gaussian == b.gaussian) {
        let gaussian = entries[0].gaussian as usize;
        let mean = scene.means_in_world[gaussian];
        let depth = camera.transform_point3(mean).z;
        let sum: f32 = entries.iter().map(|entry| entry.weight).sum();
        let scale = f64::from(scene.scales[gaussian].into_iter().fold(0.0, f32::max));
        total += f64::from(sum);
        if scale * intrinsics.focal_x_px > LARGE_PX * depth {
            large += f64::from(sum);
        }
        if sum >= MIN_WEIGHT {
            seen.push((entries[0].gaussian, side(eye - mean)));
        }
        for entry in entries {
            of_pixel[entry.region as usize].push(Layer { depth, weight: entry.weight.into() });
        }
    }
    let near = if kind == SceneKind::Object { 0.0 } else { NEAR };
    let (mut n_covered, mut n_near, mut n_hazy) = (0u32, 0u32, 0u32);
    for layers in &mut of_pixel {
        let Some((expected, median)) = depths(layers) else { continue };
        n_covered += 1;
        n_near += u32::from(median < near);
        n_hazy += u32::from((expected - median).abs() > HAZY * median);
    }
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
    Ok(Look { camera, verdict, seen })
}

/// Returns expected and median depth of a pixel; `None` for a hole.
fn depths(layers: &mut [Layer]) -> Option<(f64, f64)> {
    let total: f64 = layers.iter().map(|layer| layer.weight).sum();
    if total < f64::from(MIN_COVERED) {
        return None;
    }
    layers.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let expected = layers.iter().map(|layer| layer.weight * layer.depth).sum::<f64>() / total;
    let mut below = 0.0;
    let median = layers.iter().find(|layer| {
        below += layer.weight;
        below >= 0.5 * total
    });
    Some((expected, median.map_or(expected, |layer| layer.depth)))
}

/// Returns the side from which a Gaussian is seen, by the direction to the camera.
fn side(towards: DVec3) -> u8 {
    let turns = towards.y.atan2(towards.x) / std::f64::consts::TAU + 0.5;
    ((turns * N_SIDES as f64) as u8).min(N_SIDES as u8 - 1)
}

/// Returns whether the scene seen from above has more of large Gaussians than from below: what no photo has seen, as
/// the underside of the ground, nothing makes small.
pub(super) fn large_from_above(space: &Space, rasterizer: &dyn Rasterizer) -> Result<bool, RasterError> {
    let loaded = rasterizer.load(&space.scene)?;
    let large = |sign: f64| {
        let eye = DVec3::new(0.0, 0.0, sign * (space.half.z + 0.6 * WIDTH));
        let look = look(loaded.as_ref(), &space.scene, look_at(eye, DVec3::ZERO), SceneKind::Outdoor)?;
        Ok::<_, RasterError>(look.verdict.large)
    };
    let (above, below) = (large(1.0)?, large(-1.0)?);
    tracing::debug!("large from above {above:.2}, from below {below:.2}");
    Ok(above > below)
}
