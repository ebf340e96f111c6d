//! Names of what positions and lengths are in.

use slag_common::manifest::Manifest;

/// Name of the frame of every position: the scene's world frame (`docs/api.md`).
pub const FRAME: &str = "world";
/// Units of positions and lengths: metres, or those of a world frame without a metric scale.
pub const UNITS: [&str; 2] = ["m", "world"];

/// Returns the unit of a scene's positions and lengths.
pub fn unit(manifest: &Manifest) -> &'static str {
    UNITS[usize::from(!manifest.metric)]
}
