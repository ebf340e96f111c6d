//! Errors of planning a fetch.

use glam::DVec3;
use slag_common::Hash32;
use slag_common::shard::Profile;

/// Reasons for which a fetch cannot be planned.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    #[error("{name} is {value}, expected {expected}")]
    Number { name: &'static str, value: f64, expected: &'static str },
    #[error("scene {scene:?} has no geo-reference; give the position as x, y, z in its world frame")]
    NoGeoReference { scene: String },
    #[error(
        "scene {scene:?} has no cell within {radius} of {centre_in_world}, the nearest is {nearest:.1} away; check the position or increase the radius"
    )]
    NoCells {
        scene: String,
        centre_in_world: DVec3,
        radius: f64,
        /// Distance of the nearest cell; infinite in a scene without cells.
        nearest: f64,
    },
    #[error("cell {cell_id} has no {profile} shard; it has: {available}; fetch one of those profiles")]
    NoProfile { cell_id: u32, profile: Profile, available: String },
    #[error(
        "the {n_cells} cells need {needed_bytes} bytes, the limit is {max_bytes}; choose a smaller radius or profile, or raise the limit"
    )]
    TooLarge { n_cells: usize, needed_bytes: u64, max_bytes: u64 },
    #[error(
        "the manifest lists shard {hash} for cell {cell_id} and for another cell; have the scene published again"
    )]
    Conflict { cell_id: u32, hash: Hash32 },
}
