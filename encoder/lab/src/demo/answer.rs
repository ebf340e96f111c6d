//! An answer of the robot: the fields that the demo reads.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// A cluster of matching Gaussians.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct EdgeAnswer {
    pub position_in_world: DVec3,
    /// Edge lengths of its box.
    pub size: DVec3,
    pub score: f32,
    pub n_gaussians: u64,
    pub distance: Option<f64>,
}
