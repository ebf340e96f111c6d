//! Errors of planning a fetch.

use glam::DVec3;
use slag_common::Hash32;
use slag_common::shard::Profile;

/// Why there is no plan.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// A number that no place has.
    #[error("{name} is {value}, it must be {expected}")]
    Number {
        /// What it is.
        name: &'static str,
        /// Value found.
        value: f64,
        /// Values possible.
        expected: &'static str,
    },
    /// Latitude and longitude mean nothing in this scene.
    #[error("scene {scene:?} has no geo-reference: give the position as x, y, z in its world frame")]
    NoGeoReference {
        /// The scene.
        scene: String,
    },
    /// The place is elsewhere.
    #[error(
        "no cell of scene {scene:?} within {radius} of {centre_in_world}, the nearest is {nearest:.1} away; check the position or take a larger radius"
    )]
    NoCells {
        /// The scene.
        scene: String,
        /// Where cells were looked for.
        centre_in_world: DVec3,
        /// How far.
        radius: f64,
        /// Distance of the nearest cell; infinite in a scene without cells.
        nearest: f64,
    },
    /// The encoder did not write this profile.
    #[error("cell {cell_id} has no {profile} shard; it has: {available}")]
    NoProfile {
        /// The cell.
        cell_id: u32,
        /// Profile asked for.
        profile: Profile,
        /// Profiles there, separated by commas.
        available: String,
    },
    /// More than the robot may hold.
    #[error(
        "the {n_cells} cells take {needed_bytes} bytes, allowed are {max_bytes}; take a smaller radius or a smaller profile"
    )]
    TooLarge {
        /// Cells within the radius.
        n_cells: usize,
        /// Bytes of their shards.
        needed_bytes: u64,
        /// Bytes allowed.
        max_bytes: u64,
    },
    /// The manifest contradicts itself.
    #[error(
        "the manifest gives cell {cell_id} the shard of another cell, {hash}; have the scene published again"
    )]
    Conflict {
        /// The second cell.
        cell_id: u32,
        /// The shard.
        hash: Hash32,
    },
}
