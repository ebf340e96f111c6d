//! Errors of planning a fetch.

use glam::DVec3;
use slag_common::Hash32;
use slag_common::shard::Profile;

/// Reasons for which a fetch cannot be planned.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// A number is out of range.
    #[error("{name} is {value}, expected {expected}")]
    Number {
        /// Name of the number.
        name: &'static str,
        /// Value found.
        value: f64,
        /// Values allowed.
        expected: &'static str,
    },
    /// The scene has no geo-reference.
    #[error("scene {scene:?} has no geo-reference; give the position as x, y, z in its world frame")]
    NoGeoReference { scene: String },
    /// No cell is within the radius.
    #[error(
        "scene {scene:?} has no cell within {radius} of {centre_in_world}, the nearest is {nearest:.1} away; check the position or increase the radius"
    )]
    NoCells {
        scene: String,
        /// Centre of the search.
        centre_in_world: DVec3,
        /// Radius of the search.
        radius: f64,
        /// Distance of the nearest cell; infinite in a scene without cells.
        nearest: f64,
    },
    /// The store has no shard of this profile.
    #[error("cell {cell_id} has no {profile} shard; it has: {available}; fetch one of those profiles")]
    NoProfile {
        cell_id: u32,
        /// Profile asked for.
        profile: Profile,
        /// Available profiles, separated by commas.
        available: String,
    },
    /// The needed shards exceed the byte budget.
    #[error(
        "the {n_cells} cells need {needed_bytes} bytes, the limit is {max_bytes}; choose a smaller radius or profile, or raise the limit"
    )]
    TooLarge {
        /// Cells within the radius.
        n_cells: usize,
        /// Bytes of their shards.
        needed_bytes: u64,
        /// Bytes allowed.
        max_bytes: u64,
    },
    /// The manifest lists one shard for two cells.
    #[error(
        "the manifest lists shard {hash} for cell {cell_id} and for another cell; have the scene published again"
    )]
    Conflict {
        /// The second cell.
        cell_id: u32,
        /// The shard.
        hash: Hash32,
    },
}
