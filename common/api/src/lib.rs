//! Replies of the robot's HTTP interface, version 1, for the service, the doors and the description.

pub mod changes;
pub mod coverage;
pub mod floor;
pub mod goal;
pub mod locate;
pub mod map;
pub mod objects;

pub use slag_common::frames::Geographic;

/// Name of the frame of every position: the scene's world frame (`docs/api.md`).
pub const FRAME: &str = "world";
/// Units of positions and lengths: metres, or those of a world frame without a metric scale.
pub const UNITS: [&str; 2] = ["m", "world"];
