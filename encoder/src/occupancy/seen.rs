//! Which voxels views have looked through: those nearer than the surface at their pixel.

use glam::DVec3;
use rayon::prelude::*;
use slag_common::Intrinsics;
use slag_common::occupancy::BLOCK_EDGE;

use super::lattice::{BlockAt, Lattice};
use crate::raster::{Drawing, RasterView};

/// Views that must have looked through a voxel for it to be free: one may look through a hole in the splat.
pub const MIN_VIEWS: u32 = 2;
/// Width of the depth pictures, pixels: at 60 degrees and 8 m a pixel is 3 cm wide.
pub(super) const DEPTH_WIDTH_PX: u32 = 320;
/// Height above an occupied voxel up to which places are looked at, world units: a robot with its load.
const HEADROOM: f64 = 2.4;
/// Opacity of a pixel from which its depth is a surface's.
const MIN_COVERAGE: f32 = 0.5;
/// Opacity of a pixel up to which nothing is in its way.
const MAX_SKY: f32 = 0.1;
/// Nearest depth at which a voxel is looked for, world units.
const NEAR: f64 = 0.01;

/// A block that views may look through.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Candidate {
    pub(super) at: BlockAt,
    pub(super) occupied: u64,
    /// Voxels that at least one view has looked through.
    once: u64,
    /// Voxels that at least [`MIN_VIEWS`] views have looked through.
    pub(super) seen: u64,
}

/// Returns the blocks with an occupied voxel and those above them up to the headroom, by place. `occupied`: by place.
pub(super) fn candidates(occupied: &[(BlockAt, u64)], lattice: Lattice) -> Vec<Candidate> {
    let above = (HEADROOM / lattice.block()).ceil() as i32;
    let mut all: Vec<Candidate> = Vec::new();
    for ((at, mask), next) in occupied.iter().zip(occupied.iter().skip(1).map(Some).chain([None])) {
        let block = |z: i32, occupied| Candidate { at: [at[0], at[1], z], occupied, once: 0, seen: 0 };
        all.push(block(at[2], *mask));
        // Blocks of a column follow each other.
        let limit = next.filter(|(next, _)| next[..2] == at[..2]).map_or(i32::MAX, |(next, _)| next[2]);
        all.extend((at[2] + 1..limit.min(at[2] + above + 1)).map(|z| block(z, 0)));
    }
    all
}

/// A depth picture: how far each pixel looks.
pub(super) struct Depth {
    view: RasterView,
    /// Camera z up to which the pixel looks through, row-major; infinite where only sky is.
    until: Vec<f32>,
}

impl Depth {
    /// Takes the depth of each pixel. At the edge of a surface it lies between that surface and the one behind it, so such a pixel may look through
    /// what the nearer surface hides. It is one pixel wide, voxels with a surface are occupied in any case, and two views must agree.
    pub(super) fn new(view: RasterView, drawing: &Drawing) -> Self {
        let of_pixel = |pixel: usize| match drawing.coverage[pixel] {
            coverage if coverage >= MIN_COVERAGE => drawing.depth[pixel],
            coverage if coverage <= MAX_SKY => f32::INFINITY,
            _ => 0.0,
        };
        let until = (0..drawing.coverage.len()).map(of_pixel).collect();
        Self { view, until }
    }

    /// Notes the voxels of the candidates that this view looks through. The order of views does not matter.
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
        // Bounds of the block's ball on the image: the ball's slope from the axis, widened by its angle.
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
mod tests {
    use std::collections::{BTreeMap, BTreeSet};

    use glam::{DAffine3, DQuat};
    use slag_common::Distortion;
    use slag_math::random::Random;

    use super::*;

    const LATTICE: Lattice = Lattice { voxel: 0.1 };

    /// Looks from a random place near the origin. A third of the pixels show a surface 0.3 to 3 m away in patches, others the sky
    /// or something half transparent.
    fn random_picture(random: &mut Random) -> (RasterView, Drawing) {
        let rotation = DQuat::from_xyzw(random.normal(), random.normal(), random.normal(), random.normal());
        let place = DVec3::from([0; 3].map(|_| random.between(-1.0, 1.0)));
        let camera_from_world = DAffine3::from_rotation_translation(rotation.normalize(), place);
        let (width_px, height_px) = (40, 30);
        let intrinsics = Intrinsics {
            width_px,
            height_px,
            focal_x_px: 30.0,
            focal_y_px: 34.0,
            centre_x_px: 18.5,
            centre_y_px: 16.0,
            distortion: Distortion::None,
        };
        // Patches of 8 x 8 pixels: the neighbours of a pixel mostly agree.
        let patches: Vec<(f32, f32)> = (0..20)
            .map(|_| (*random_of(random, &[1.0, 0.6, 0.5, 0.4, 0.05, 0.0]), random.between(0.3, 3.0) as f32))
            .collect();
        let of_pixel = |pixel: u32| patches[(pixel / width_px / 8 * 5 + pixel % width_px / 8) as usize];
        let pixels = || (0..width_px * height_px).map(of_pixel);
        let drawing = Drawing {
            width_px,
            height_px,
            coverage: pixels().map(|(coverage, _)| coverage).collect(),
            depth: pixels().map(|(_, depth)| depth).collect(),
            ..Drawing::default()
        };
        (RasterView { camera_from_world, intrinsics }, drawing)
    }

    fn random_of<'a, T>(random: &mut Random, of: &'a [T]) -> &'a T {
        &of[random.below(of.len() as u64) as usize]
    }

    /// The definition of `docs/numerics.md`, in f64, pixel by pixel.
    fn looks_through(view: &RasterView, drawing: &Drawing, voxel: [i32; 3]) -> bool {
        let centre = (DVec3::from(voxel.map(f64::from)) + 0.5) * LATTICE.voxel;
        let at = view.camera_from_world.matrix3 * centre + view.camera_from_world.translation;
        if at.z < 0.01 {
            return false;
        }
        let of = &view.intrinsics;
        let x = (of.focal_x_px * at.x / at.z + of.centre_x_px).floor();
        let y = (of.focal_y_px * at.y / at.z + of.centre_y_px).floor();
        let is_inside = x >= 0.0 && y >= 0.0 && x < 40.0 && y < 30.0;
        is_inside && {
            let pixel = y as usize * 40 + x as usize;
            match drawing.coverage[pixel] {
                0.5.. => at.z <= f64::from(drawing.depth[pixel]),
                coverage => coverage <= 0.1,
            }
        }
    }

    /// Oracle: the definition, for every voxel and every view.
    #[test]
    fn two_views_that_look_through_make_a_voxel_seen() {
        let mut random = Random::new(8);
        let places = (-7..7).flat_map(|x| (-7..7).flat_map(move |y| (-7..7).map(move |z| [x, y, z])));
        let mut found: Vec<Candidate> = places
            .map(|at| Candidate { at, occupied: random.bits() & random.bits(), once: 0, seen: 0 })
            .collect();
        let mut n_views: BTreeMap<[i32; 3], u32> = BTreeMap::new();
        let (mut n_seen, mut n_once) = (0, 0);
        for round in 0..5 {
            let (view, drawing) = random_picture(&mut random);
            Depth::new(view, &drawing).look(LATTICE, &mut found);
            for candidate in &found {
                for bit in (0..64i32).filter(|bit| candidate.occupied >> bit & 1 == 0) {
                    let offset = [bit / 16, bit / 4 % 4, bit % 4];
                    let voxel = [0, 1, 2].map(|axis| 4 * candidate.at[axis] + offset[axis]);
                    let n = n_views.entry(voxel).or_default();
                    *n += u32::from(looks_through(&view, &drawing, voxel));
                    let is_seen = candidate.seen >> bit & 1 == 1;
                    assert_eq!(is_seen, *n >= MIN_VIEWS, "{voxel:?} in round {round}: {n} views");
                    n_seen += u32::from(is_seen);
                    n_once += u32::from(*n == 1);
                }
            }
        }
        assert!(n_seen > 1000 && n_once > 1000, "{n_seen} {n_once}");
    }

    /// Oracle: sets. 2.4 m are six blocks of 0.4 m.
    #[test]
    fn places_above_surfaces_are_looked_at() {
        let mut random = Random::new(21);
        let mut occupied: BTreeMap<BlockAt, u64> = BTreeMap::new();
        for _ in 0..60 {
            occupied.insert([0; 3].map(|_| random.below(20u64) as i32), 1 + random.below(99u64));
        }
        let expected: BTreeSet<BlockAt> =
            occupied.keys().flat_map(|at| (0..=6).map(|up| [at[0], at[1], at[2] + up])).collect();
        let found = candidates(&occupied.clone().into_iter().collect::<Vec<_>>(), LATTICE);
        assert!(found.is_sorted_by(|a, b| a.at < b.at), "each once, by place");
        assert_eq!(found.iter().map(|of| of.at).collect::<BTreeSet<_>>(), expected);
        for of in &found {
            assert_eq!(of.occupied, occupied.get(&of.at).copied().unwrap_or(0), "{:?}", of.at);
        }
    }
}
