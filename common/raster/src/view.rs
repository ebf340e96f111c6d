//! The camera of a view.

use glam::DAffine3;
use slag_common::{Distortion, Intrinsics, View};

/// A posed pinhole camera at raster resolution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterView {
    /// Rigid transform from world to camera (OpenCV axes).
    pub camera_from_world: DAffine3,
    /// Intrinsics of the camera, without distortion.
    pub intrinsics: Intrinsics,
}

impl RasterView {
    /// Returns the camera of a view, at the size of its photo.
    pub fn of(view: &View) -> Self {
        Self { camera_from_world: view.camera_from_world, intrinsics: view.intrinsics }
    }
}

/// Returns the intrinsics of an ideal lens with square pixels, whose axis meets the middle of the image.
pub fn pinhole([width_px, height_px]: [u32; 2], focal_px: f64) -> Intrinsics {
    Intrinsics {
        width_px,
        height_px,
        focal_x_px: focal_px,
        focal_y_px: focal_px,
        centre_x_px: f64::from(width_px) / 2.0,
        centre_y_px: f64::from(height_px) / 2.0,
        distortion: Distortion::None,
    }
}
