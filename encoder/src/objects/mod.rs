//! Stage 5: superpoints that the masks of most views show together become objects.
//!
//! No model and no training are needed: the contributions tell which Gaussians each mask shows.
//!
//! | file | job |
//! |---|---|
//! | `scene` | the input |
//! | `find` | the steps below, in order |
//! | [`shown`] | what each view shows of each superpoint, under which masks |
//! | [`near`] | pairs of superpoints that lie near each other |
//! | [`affinity`] | how much masks speak for a pair being of one thing |
//! | [`tree`] | superpoints joined pair by pair |
//! | [`choice`] | the nodes of the tree that views agree on: the objects, and their masks |
//! | [`members`] | the Gaussians and masks of each object |
//! | [`vectors`] | the few vectors that represent an object's masks |
//! | [`shards`] | the objects of a cell, as its shards store them |
//! | `object` | the result |
//!
//! The contributions are needed once, part by part; the result takes four bytes a Gaussian.

pub mod affinity;
pub mod choice;
mod find;
pub mod members;
pub mod near;
mod object;
mod scene;
pub mod shards;
pub mod shown;
pub mod tree;
pub mod vectors;

use crate::lift::superpoint::{SuperpointSettings, Superpoints};
use crate::memory::{MemoryPlan, Phase};
pub use find::{MIN_GAUSSIANS, find};
pub use object::{NONE, Object, ObjectsReport, SceneObjects};
pub use scene::Scene;
pub use shown::expected_bytes;

/// Reserves what finding the objects of a scene takes, and the object of each Gaussian. `has_superpoints`: they are given.
pub fn reserve(memory: &mut MemoryPlan, n_gaussians: usize, has_superpoints: bool) {
    members::reserve(memory, n_gaussians);
    near::reserve(memory, n_gaussians);
    if !has_superpoints {
        let len_bytes = Superpoints::working_bytes(n_gaussians, 1, &SuperpointSettings::default())
            + (n_gaussians * size_of::<u32>()) as u64;
        memory.reserve(Phase::Objects, "superpoints of all Gaussians", len_bytes);
    }
}

/// Reserves what depends on the contributions, once all views are done.
pub fn reserve_contributions(memory: &mut MemoryPlan, n_entries: u64) {
    shown::reserve(memory, n_entries);
}

#[cfg(test)]
mod tests;
