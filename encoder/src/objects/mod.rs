//! Stage 5: masks of different views that cover the same Gaussians become objects.
//!
//! No model and no training are needed: the contributions tell which Gaussians each mask shows. Superpoints, where the
//! refinements make them, say where a thing ends.
//!
//! | file | job |
//! |---|---|
//! | `scene` | the input |
//! | `find` | the steps below, in order |
//! | [`sightings`] | the region of each sampled Gaussian in each view |
//! | [`consensus`] | clusters of masks that views agree to show one thing |
//! | [`members`] | each Gaussian's object, by its weight under the objects' masks |
//! | `views` | the views that have masks of an object |
//! | [`pieces`] | each superpoint's object, by its Gaussians |
//! | [`vectors`] | the few vectors that represent an object's masks |
//! | [`shards`] | the objects of a cell, as its shards store them |
//! | `object` | the result |
//! | `file` | its file form, for machines that build cells |
//!
//! The contributions are needed twice, part by part; the result takes four bytes a Gaussian.

pub mod consensus;
mod file;
mod find;
pub mod members;
mod object;
pub mod pieces;
mod scene;
pub mod shards;
pub mod sightings;
pub mod vectors;
mod views;

use crate::lift::RegionTable;
use crate::memory::MemoryPlan;
pub use find::{MIN_GAUSSIANS, find};
pub use object::{NONE, Object, ObjectsReport, SceneObjects};
pub use scene::Scene;
pub use sightings::expected_bytes;

/// Reserves what finding the objects of a scene takes, and the object of each Gaussian.
pub fn reserve(memory: &mut MemoryPlan, n_gaussians: usize, n_views: usize) {
    members::reserve(memory, n_gaussians);
    pieces::reserve(memory, n_gaussians);
    sightings::reserve(memory, n_gaussians, n_views);
}

/// Reserves what depends on the masks, once all views are done.
pub fn reserve_masks(memory: &mut MemoryPlan, table: &RegionTable, n_gaussians: usize, n_views: usize) {
    let most_masks = (0..table.len()).map(|region| table.all_masks_of(region).len()).max().unwrap_or(0);
    sightings::reserve_masks(memory, n_gaussians, n_views, (table.n_masks(), most_masks));
}

#[cfg(test)]
mod tests;
