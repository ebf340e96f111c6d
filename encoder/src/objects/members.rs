//! The Gaussians and masks of each object.

use super::object::NONE;
use super::scene::Scene;
use super::shown::Shown;
use crate::lift::superpoint::Superpoints;
use crate::memory::{MemoryPlan, Phase};

/// The Gaussians and masks of each object.
pub struct Members {
    /// `[cell][N of the cell]`: the object of each Gaussian, or [`NONE`].
    pub object_of: Vec<Vec<u32>>,
    /// The masks of each object, ascending.
    pub masks: Vec<Vec<u32>>,
    /// `[n_masks]`: blending weight of all Gaussians under the mask, pixels.
    pub mask_weights: Vec<f64>,
    /// `[n_masks]`: of that, the weight of the Gaussians of its object.
    own_weights: Vec<f64>,
}

/// Reserves the object of each Gaussian.
pub(super) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
    memory.reserve(Phase::Always, "the object of each Gaussian", (n_gaussians * size_of::<u32>()) as u64);
}

impl Members {
    /// Collects the members of objects. `object_of`: of each superpoint; `object_of_mask`: of each mask.
    pub fn new(
        scene: &Scene<'_>,
        superpoints: &Superpoints,
        shown: &Shown,
        object_of: &[Option<u32>],
        object_of_mask: &[Option<u32>],
    ) -> Self {
        let of_gaussian = |gaussian: &u32| {
            let superpoint = superpoints.of_gaussian[*gaussian as usize];
            object_of.get(superpoint as usize).copied().flatten().unwrap_or(NONE)
        };
        let cells = scene.split.cells.iter();
        let n_objects = object_of.iter().flatten().max().map_or(0, |last| *last as usize + 1);
        let mut members = Self {
            object_of: cells.map(|cell| cell.gaussians.iter().map(of_gaussian).collect()).collect(),
            masks: vec![Vec::new(); n_objects],
            mask_weights: vec![0.0; object_of_mask.len()],
            own_weights: vec![0.0; object_of_mask.len()],
        };
        for (mask, object) in (0u32..).zip(object_of_mask) {
            object.iter().for_each(|object| members.masks[*object as usize].push(mask));
        }
        for (superpoint, of_mask) in shown.masks() {
            let mask = of_mask.mask as usize;
            members.mask_weights[mask] += of_mask.weight;
            if object_of_mask[mask].is_some() && object_of_mask[mask] == object_of[superpoint] {
                members.own_weights[mask] += of_mask.weight;
            }
        }
        members
    }

    /// Returns the mask that shows an object best: the one with the largest product of the weight of the object's
    /// Gaussians, their share of the mask's weight, and 1 - truncation.
    pub fn best_mask(&self, masks: &[u32], uncut_shares: &[f32]) -> u32 {
        let merit = |mask: u32| {
            let (own, all) = (self.own_weights[mask as usize], self.mask_weights[mask as usize]);
            if all > 0.0 { own * own / all * f64::from(uncut_shares[mask as usize]) } else { 0.0 }
        };
        let better = |a: u32, b: u32| if merit(b) > merit(a) { b } else { a };
        masks.iter().copied().reduce(better).unwrap_or(NONE)
    }
}
