//! Which voxels views have looked through: those nearer than the surface at their pixel.

use glam::DVec3;
use rayon::prelude::*;
use slag_common::Intrinsics;
use slag_common::occupancy::BLOCK_EDGE;

use super::owners::{BlockAt, Lattice};
use crate::raster::{Drawing, RasterView};

/// Views that must look through a free voxel: one may look through a hole in the splat.
pub(crate) const MIN_VIEWS: u32 = 2;
/// Width of the depth pictures, pixels: at 60 degrees and 8 m a pixel is 3 cm wide.
pub(super) const DEPTH_WIDTH_PX: u32 = 320;
/// Height above an occupied voxel up to which places are examined, world units: a robot with its load.
const HEADROOM: f64 = 2.4;
/// Opacity from which a pixel shows a surface.
const MIN_COVERAGE: f32 = 0.5;
/// Largest opacity of a pixel with nothing in its way.
const MAX_SKY: f32 = 0.1;
/// Nearest depth of an examined voxel, world units.
const NEAR: f64 = 0.01;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Candidate {
    pub(super) at: BlockAt,
    pub(super) occupied: u64,
    /// Voxels that a view looks through.
    once: u64,
    /// Voxels that at least [`MIN_VIEWS`] views look through.
    pub(super) seen: u64,
}

/// Blocks with an occupied voxel, and those above them up to the headroom, by place. `occupied`: by place.
pub(super) fn candidates(occupied: &[(BlockAt, u64)], lattice: Lattice) -> impl Iterator<Item = Candidate> {
    let above = (HEADROOM / lattice.block()).ceil() as i32;
    let with_next = occupied.iter().zip(occupied.iter().skip(1).map(Some).chain([None]));
    with_next.flat_map(move |((at, mask), next)| {
        let block = |z: i32, occupied| Candidate { at: [at[0], at[1], z], occupied, once: 0, seen: 0 };
        // Blocks of a column are consecutive.
        let limit = next.filter(|(next, _)| next[..2] == at[..2]).map_or(i32::MAX, |(next, _)| next[2]);
        let higher = at[2] + 1..limit.min(at[2] + above + 1);
        std::iter::once(block(at[2], *mask)).chain(higher.map(move |z| block(z, 0)))
    })
}

pub(super) struct Depth {
    view: RasterView,
    /// Camera z up to which the pixel looks through, row-major; infinite for sky.
    until: Vec<f32>,
}

impl Depth {
    /// Takes each pixel's depth. At a surface's edge it lies between that surface and the one behind, so the pixel may
    /// look through what is hidden; but it is one pixel wide, voxels with a surface are occupied anyway, and two views
    /// must agree.
    pub(super) fn new(view: RasterView, drawing: &Drawing) -> Self {
        let of_pixel = |pixel: usize| match drawing.coverage[pixel] {
            coverage if coverage >= MIN_COVERAGE => drawing.depth[pixel],
            coverage if coverage <= MAX_SKY => f32::INFINITY,
            _ => 0.0,
        };
        let until = (0..drawing.coverage.len()).map(of_pixel).collect();
        Self { view, until }
    }

    /// Marks the candidates' voxels that this view looks through; the order of views does not matter.
    pub(super) fn look(&self, lattice: Lattice, candidates: &mut [Candidate]) {
        candidates.par_chunks_mut(1024).for_each(|chunk| {
            chunk.iter_mut().for_each(|candidate| {
                let now = self.looked_through(lattice, candidate);
                candidate.seen |= candidate.once & now;
                candidate.once |= now;
            });
        });
    }

    fn looked_through(&self, lattice: Lattice, candidate: &Candidate) -> u64 {
        if (candidate.seen | candidate.occupied) == !0 {
            return 0;
        }
        let Intrinsics { width_px, height_px, focal_x_px, focal_y_px, centre_x_px, centre_y_px, .. } =
            self.view.intrinsics;
        let camera_from_world = &self.view.camera_from_world;
        let centre = camera_from_world.transform_point3(lattice.centre(candidate.at));
        let radius = lattice.block() * 0.75f64.sqrt();
        if centre.z + radius < NEAR {
            return 0;
        }
        // Bounds of the block's sphere on the image: the sphere's slope from the axis, widened by its angle.
        if centre.z > radius {
            let beyond = |at: f64, focal: f64, low: f64, high: f64| {
                let reach = radius * (1.0 + (at / centre.z).abs()) / (centre.z - radius);
                at / centre.z + reach < low / focal || at / centre.z - reach > high / focal
            };
            let (w, h) = (f64::from(width_px), f64::from(height_px));
            if beyond(centre.x, focal_x_px, -centre_x_px, w - centre_x_px)
                || beyond(centre.y, focal_y_px, -centre_y_px, h - centre_y_px)
            {
                return 0;
            }
        }
        let m = camera_from_world.matrix3 * lattice.voxel;
        let first = camera_from_world.transform_point3(lattice.corner(candidate.at) + 0.5 * lattice.voxel);
        let mut mask = 0;
        for x in 0..BLOCK_EDGE {
            for y in 0..BLOCK_EDGE {
                let row = first + m.x_axis * f64::from(x) + m.y_axis * f64::from(y);
                for z in 0..BLOCK_EDGE {
                    let at: DVec3 = row + m.z_axis * f64::from(z);
                    if at.z < NEAR {
                        continue;
                    }
                    let u = focal_x_px * at.x / at.z + centre_x_px;
                    let v = focal_y_px * at.y / at.z + centre_y_px;
                    if u < 0.0 || v < 0.0 || u >= f64::from(width_px) || v >= f64::from(height_px) {
                        continue;
                    }
                    let until = self.until[v as usize * width_px as usize + u as usize];
                    let sees = at.z <= f64::from(until);
                    mask |= u64::from(sees) << (z + BLOCK_EDGE * (y + BLOCK_EDGE * x));
                }
            }
        }
        mask
    }
}

#[cfg(test)]
mod tests;
