//! `POST /v1/locate`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::Geographic;

/// Where the camera is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "state", rename_all = "lowercase")]
pub enum Answer {
    /// One pose agrees with enough landmarks.
    Found(Pose),
    /// Poses that agree with some landmarks: too few, or as many as another place does.
    Unsure {
        /// Why none is the answer.
        reason: String,
        /// Best first.
        candidates: Vec<Pose>,
    },
    /// The photo has no place here.
    Lost {
        /// Why.
        reason: String,
    },
}

/// Pose of a camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Pose {
    /// The camera, world frame; east, north, up of the scene's origin if it has one.
    pub position_in_world: [f64; 3],
    /// World from camera with the axes of REP-103 (x forward, y left, z up): x, y, z, w.
    pub rotation_xyzw: [f64; 4],
    /// World from camera with the axes of images (x right, y down, z forward): x, y, z, w.
    pub optical_rotation_xyzw: [f64; 4],
    /// Of x, y, z and rotations about the world's x, y, z, row by row: 36 numbers, square world units and radians.
    pub covariance: Vec<f64>,
    /// Points that agree with the pose.
    pub n_inliers: usize,
    pub verified_by: Verification,
    /// The same on the earth, where the scene has a geo-reference.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geographic: Option<Geographic>,
}

/// What agrees with a pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Verification {
    /// Landmarks alone.
    Landmarks,
    /// A picture of the scene at the pose, which looks like the photo.
    Rendering,
}

impl Pose {
    /// Returns the largest standard deviation of the position along the world's axes, world units.
    pub fn position_sigma(&self) -> f64 {
        let variance = |axis: usize| self.covariance.get(7 * axis).copied().unwrap_or(f64::INFINITY);
        (0..3).map(variance).fold(0.0, f64::max).sqrt()
    }
}
