//! The camera of a view.

use glam::DAffine3;
use slag_common::Intrinsics;

/// A posed pinhole camera at raster resolution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterView {
    /// Rigid transform from world to camera (OpenCV axes).
    pub camera_from_world: DAffine3,
    /// Intrinsics of the camera, without distortion.
    pub intrinsics: Intrinsics,
}
