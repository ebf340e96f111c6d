//! Stage 5: superpoints that the masks of most views show together become objects.
//!
//! No model and no training are needed: the contributions tell which Gaussians each mask shows.
//!
//! The contributions are needed once, part by part; the result takes four bytes a Gaussian.

mod choice;
mod find;
mod object;
pub(crate) mod shards;
mod sightings;
mod tree;

use crate::lift::superpoint::{SuperpointSettings, Superpoints};
use crate::memory::{MemoryPlan, Phase};
pub(crate) use find::find;
pub use object::{NONE, Object, ObjectsReport, SceneObjects};
pub(crate) use shards::cut as cut_thumbnails;

/// Reserves the search for objects, and each Gaussian's object. `has_superpoints`: they are given.
pub(crate) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize, has_superpoints: bool) {
    let labels_bytes = (n_gaussians * size_of::<u32>()) as u64;
    memory.reserve(Phase::Always, "the object of each Gaussian", labels_bytes);
    tree::reserve(memory, n_gaussians);
    if !has_superpoints {
        let len_bytes = Superpoints::working_bytes(n_gaussians, 1, &SuperpointSettings::default());
        memory.reserve(Phase::Objects, "superpoints of all Gaussians", len_bytes + labels_bytes);
    }
}

pub(crate) fn reserve_contributions(memory: &mut MemoryPlan, n_entries: u64) {
    sightings::reserve(memory, n_entries);
}

#[cfg(test)]
mod tests;
