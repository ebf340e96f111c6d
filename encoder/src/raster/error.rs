//! The errors of the rasteriser.

use super::constants::MAX_IMAGE_PX;

/// Reason why a view cannot be rasterised.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum RasterError {
    #[error("scene column {column} has {found} values, expected {expected}; read the scene again")]
    ColumnLength {
        /// Field of [`slag_common::Gaussians`].
        column: &'static str,
        /// Number of values for the number of means.
        expected: usize,
        /// Actual number of values.
        found: usize,
    },
    #[error("the scene has {found} Gaussians, expected at most {max}; split it into parts", max = u32::MAX)]
    SceneSize {
        /// Number of Gaussians.
        found: usize,
    },
    #[error("spherical harmonics of degree {found}, expected at most 3; convert the scene")]
    ShDegree {
        /// The scene's degree.
        found: u8,
    },
    #[error(
        "image of {width_px} x {height_px} px, expected 1 to {max} px in total; choose another raster width",
        max = MAX_IMAGE_PX
    )]
    ImageSize { width_px: u32, height_px: u32 },
    #[error("the camera has lens distortion; undistort the image and use its pinhole camera")]
    Distorted,
    #[error(
        "invalid camera: focal lengths {focal_px:?} px, principal point {centre_px:?} px; correct the intrinsics"
    )]
    Camera {
        /// Focal lengths x, y.
        focal_px: [f64; 2],
        /// Principal point x, y.
        centre_px: [f64; 2],
    },
    #[error("the pose is not rigid (deviation {off:e}); correct the rotation of the view")]
    Pose {
        /// Largest entry of `R'R - I`; infinite for a reflection, NaN if the pose is not finite.
        off: f64,
    },
    #[error(
        "the region map has {} x {} px ({found_values} values) but the view {} x {} px; \
         rasterise at the resolution of the masks",
        found_px[0], found_px[1], expected_px[0], expected_px[1]
    )]
    RegionMapSize {
        /// Width and height of the view.
        expected_px: [u32; 2],
        /// Width and height of the map.
        found_px: [u32; 2],
        /// Number of values in the map.
        found_values: usize,
    },
    #[error("{adapter}: {what}; use --device cpu to work without it")]
    Device {
        /// Name of the device.
        adapter: String,
        what: String,
    },
    #[error("{adapter}: {what}; rasterise at a smaller width or use --device cpu")]
    DeviceCapacity {
        /// Name of the device.
        adapter: String,
        /// The missing resource.
        what: String,
    },
    #[error(
        "pixel {pixel} has region {found}, but the map has {n_regions} regions; create the region map again"
    )]
    Region {
        /// Row-major index of the pixel.
        pixel: usize,
        /// The region of the pixel.
        found: u32,
        n_regions: u32,
    },
}
