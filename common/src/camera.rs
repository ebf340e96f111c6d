//! Cameras: intrinsics, lens distortion and posed views.

use std::path::PathBuf;

use glam::{DAffine3, DVec3};
use serde::{Deserialize, Serialize};

/// Lens distortion, acting on normalised image coordinates (x/z, y/z).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Distortion {
    /// An ideal pinhole.
    None,
    /// Brown-Conrady as OpenCV and COLMAP have it (SIMPLE_RADIAL, RADIAL, OPENCV): radial
    /// `k1 k2 k3`, tangential `p1 p2`.
    Brown {
        /// Radial coefficients of r^2, r^4, r^6.
        k: [f64; 3],
        /// Tangential coefficients.
        p: [f64; 2],
    },
    /// Kannala-Brandt (OPENCV_FISHEYE): theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
    Fisheye {
        /// Coefficients of theta^2, theta^4, theta^6, theta^8.
        k: [f64; 4],
    },
}

/// The inner geometry of a camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Image width, pixels.
    pub width_px: u32,
    /// Image height, pixels.
    pub height_px: u32,
    /// Focal length along x, pixels.
    pub focal_x_px: f64,
    /// Focal length along y, pixels.
    pub focal_y_px: f64,
    /// Principal point, x, pixels (the centre of the first pixel is 0.5).
    pub centre_x_px: f64,
    /// Principal point, y, pixels.
    pub centre_y_px: f64,
    /// Lens distortion.
    pub distortion: Distortion,
}

impl Intrinsics {
    /// Returns the same camera with another image width; the height keeps the aspect ratio
    /// (rounded to a pixel, at least 1).
    pub fn scaled_to_width(&self, width_px: u32) -> Self {
        let height_px = ((f64::from(self.height_px) * f64::from(width_px) / f64::from(self.width_px)).round()
            as u32)
            .max(1);
        let sx = f64::from(width_px) / f64::from(self.width_px);
        let sy = f64::from(height_px) / f64::from(self.height_px);
        Self {
            width_px,
            height_px,
            focal_x_px: self.focal_x_px * sx,
            focal_y_px: self.focal_y_px * sy,
            centre_x_px: self.centre_x_px * sx,
            centre_y_px: self.centre_y_px * sy,
            distortion: self.distortion,
        }
    }

    /// Returns the same camera as an ideal pinhole.
    pub fn without_distortion(&self) -> Self {
        Self { distortion: Distortion::None, ..*self }
    }
}

/// A posed image.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Its name, unique in the set: the image's path relative to the image folder, `/` as separator.
    pub name: String,
    /// Where the image file is expected.
    pub image_path: PathBuf,
    /// The camera it was taken with.
    pub intrinsics: Intrinsics,
    /// The rigid transform from world to camera (OpenCV axes).
    pub camera_from_world: DAffine3,
}

impl View {
    /// Returns the camera's centre.
    pub fn position_in_world(&self) -> DVec3 {
        self.camera_from_world.inverse().translation
    }
}
