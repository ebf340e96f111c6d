//! An answer of the robot, as far as the demo reads it.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// A cluster of matching Gaussians.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct EdgeAnswer {
    /// Its place.
    pub position_in_world: DVec3,
    /// Edge lengths of its box.
    pub size: DVec3,
    /// Its score.
    pub score: f32,
    /// Its Gaussians.
    pub n_gaussians: u64,
    /// Distance from the robot.
    pub distance: Option<f64>,
}
