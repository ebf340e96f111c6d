//! The reply to `POST /v1/locate`.

use serde::Deserialize;

use crate::reply::Geographic;

/// Where the camera of a photo is.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "state", rename_all = "lowercase")]
pub enum Whereabouts {
    Found(CameraPose),
    /// Candidate poses, best first; none is certain.
    Unsure {
        reason: String,
        candidates: Vec<CameraPose>,
    },
    Lost {
        reason: String,
    },
}

/// Pose of a camera. Members that clients here do not need are left out.
#[derive(Clone, Debug, Deserialize)]
pub struct CameraPose {
    pub position_in_world: [f64; 3],
    /// World from camera, x forward, y left, z up (REP-103): x, y, z, w.
    pub rotation_xyzw: [f64; 4],
    /// The same, x right, y down, z forward (axes of images).
    pub optical_rotation_xyzw: [f64; 4],
    /// `[6][6]`: x, y, z and rotations about the world's x, y, z.
    pub covariance: Vec<f64>,
    /// The same on the earth, where the scene is geo-referenced.
    pub geographic: Option<Geographic>,
}
