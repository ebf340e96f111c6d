//! Cameras: intrinsics, lens distortion and posed views.

use std::path::PathBuf;

use glam::{DAffine3, DVec3};
use serde::{Deserialize, Serialize};

/// Lens distortion, acting on normalised image coordinates (x/z, y/z).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Distortion {
    /// An ideal pinhole.
    None,
    /// Brown-Conrady as in OpenCV and COLMAP (SIMPLE_RADIAL, RADIAL, OPENCV): radial `k1 k2 k3`, tangential `p1
    /// p2`.
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

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    pub width_px: u32,
    pub height_px: u32,
    pub focal_x_px: f64,
    pub focal_y_px: f64,
    /// Principal point, x, pixels (the centre of the first pixel is 0.5).
    pub centre_x_px: f64,
    pub centre_y_px: f64,
    pub distortion: Distortion,
}

/// Returns the intrinsics of an undistorted lens with square pixels, centred on the image.
pub const fn pinhole([width_px, height_px]: [u32; 2], focal_px: f64) -> Intrinsics {
    Intrinsics {
        width_px,
        height_px,
        focal_x_px: focal_px,
        focal_y_px: focal_px,
        centre_x_px: width_px as f64 / 2.0,
        centre_y_px: height_px as f64 / 2.0,
        distortion: Distortion::None,
    }
}

/// Normalised radius beyond which images are ignored: 89.4 degrees off the axis.
const MAX_NORMALISED_RADIUS: f64 = 100.0;

impl Distortion {
    /// Returns the distorted position of an ideal normalised point (x/z, y/z).
    ///
    /// Brown: `x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)`, and y accordingly. Fisheye:
    /// `x theta_d / r` with `theta = atan r`. Both as in OpenCV's `calib3d` and COLMAP's models of these names.
    pub fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        match *self {
            Self::None => [x, y],
            Self::Brown { k: [k1, k2, k3], p: [p1, p2] } => {
                let r2 = x * x + y * y;
                let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                [
                    x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                ]
            }
            Self::Fisheye { k: [k1, k2, k3, k4] } => {
                let r = x.hypot(y);
                // The limit of theta_d / r at the axis; the next term of the series is r^2 / 3.
                if r < 1e-9 {
                    return [x, y];
                }
                let theta = r.atan();
                let t2 = theta * theta;
                let scale = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r;
                [x * scale, y * scale]
            }
        }
    }

    /// Returns whether the tangential terms fold the image at an ideal normalised point: the derivative of
    /// [`Self::distort`], which is symmetric, is not positive definite, so another direction has the same pixel.
    /// The determinant alone would be positive again where the image folds along both axes.
    pub fn folds_at(&self, [x, y]: [f64; 2]) -> bool {
        let Self::Brown { k: [k1, k2, k3], p: [p1, p2] } = *self else { return false };
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3));
        let xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x;
        let yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x;
        let xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        let is_positive = xx > 0.0 && xx * yy - xy * xy > 0.0;
        !is_positive
    }

    /// Returns the normalised radius up to which the radial part grows with the radius.
    ///
    /// Beyond it the polynomial maps a second direction to the same pixel; such directions are not imaged.
    /// [`Self::folds_at`] is the criterion for tangential terms.
    pub fn monotonic_radius(&self) -> f64 {
        match *self {
            Self::None => MAX_NORMALISED_RADIUS,
            Self::Brown { k: [k1, k2, k3], .. } => {
                let max_r2 = MAX_NORMALISED_RADIUS * MAX_NORMALISED_RADIUS;
                roots_between(&[1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3], 0.0, max_r2)
                    .first()
                    .map_or(MAX_NORMALISED_RADIUS, |r2| r2.sqrt())
            }
            Self::Fisheye { k: [k1, k2, k3, k4] } => {
                let max_theta = MAX_NORMALISED_RADIUS.atan();
                roots_between(&[1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4], 0.0, max_theta * max_theta)
                    .first()
                    .map_or(MAX_NORMALISED_RADIUS, |t2| t2.sqrt().tan())
            }
        }
    }
}

impl Intrinsics {
    /// See [`Distortion::distort`].
    pub fn distort(&self, normalised: [f64; 2]) -> [f64; 2] {
        self.distortion.distort(normalised)
    }

    pub fn pixel_from_distorted(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [x * self.focal_x_px + self.centre_x_px, y * self.focal_y_px + self.centre_y_px]
    }

    pub fn distorted_from_pixel(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        [(u - self.centre_x_px) / self.focal_x_px, (v - self.centre_y_px) / self.focal_y_px]
    }

    /// Returns the camera for another image size; focal lengths and centre scale with it.
    pub fn scaled_to(&self, width_px: u32, height_px: u32) -> Self {
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

    /// Returns the camera for another image width; the height keeps the aspect ratio, rounded, at least 1.
    pub fn scaled_to_width(&self, width_px: u32) -> Self {
        let height_px = ((f64::from(self.height_px) * f64::from(width_px) / f64::from(self.width_px)).round()
            as u32)
            .max(1);
        self.scaled_to(width_px, height_px)
    }

    pub fn without_distortion(&self) -> Self {
        Self { distortion: Distortion::None, ..*self }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Unique in the set: the image's path relative to the image folder, with `/` as separator.
    pub name: String,
    pub image_path: PathBuf,
    pub intrinsics: Intrinsics,
    /// The rigid transform from world to camera (OpenCV axes).
    pub camera_from_world: DAffine3,
}

impl View {
    pub fn position_in_world(&self) -> DVec3 {
        self.camera_from_world.inverse().translation
    }
}

/// Returns the ascending points of `low..high` at which a polynomial (coefficients from the constant term up)
/// changes sign: at most one between two roots of its derivative.
pub fn roots_between(coefficients: &[f64], low: f64, high: f64) -> Vec<f64> {
    if coefficients.len() < 2 {
        return Vec::new();
    }
    let value = |x: f64| coefficients.iter().rev().fold(0.0, |sum, c| sum * x + c);
    let derivative: Vec<f64> =
        coefficients.iter().enumerate().skip(1).map(|(power, c)| power as f64 * c).collect();
    let mut turns = vec![low];
    turns.extend(roots_between(&derivative, low, high));
    turns.push(high);
    let mut roots = Vec::new();
    for pair in turns.windows(2) {
        let (mut a, mut b) = (pair[0], pair[1]);
        if (value(a) > 0.0) == (value(b) > 0.0) {
            continue;
        }
        let positive_at_a = value(a) > 0.0;
        // 100 halvings exhaust the 53 bits of the mantissa for any interval used here.
        for _ in 0..100 {
            let middle = 0.5 * (a + b);
            if (value(middle) > 0.0) == positive_at_a { a = middle } else { b = middle }
        }
        roots.push(a);
    }
    roots
}

#[cfg(test)]
mod tests;
