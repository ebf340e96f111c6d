//! The errors of the rasteriser.

use super::constants::MAX_IMAGE_PX;

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum RasterError {
    #[error("scene column {column} has {found} values, expected {expected}; read the scene again")]
    ColumnLength { column: &'static str, expected: usize, found: usize },
    #[error("the scene has {found} Gaussians, expected at most {max}; split it into parts", max = u32::MAX)]
    SceneSize { found: usize },
    #[error("spherical harmonics of degree {found}, expected at most 3; convert the scene")]
    ShDegree { found: u8 },
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
    Camera { focal_px: [f64; 2], centre_px: [f64; 2] },
    #[error("the pose is not rigid (deviation {off:e}); correct the rotation of the view")]
    Pose { off: f64 },
    #[error(
        "the region map has {} x {} px ({found_values} values) but the view {} x {} px; \
         rasterise at the resolution of the masks",
        found_px[0], found_px[1], expected_px[0], expected_px[1]
    )]
    RegionMapSize { expected_px: [u32; 2], found_px: [u32; 2], found_values: usize },
    #[error("{adapter}: {what}; use --device cpu to work without it")]
    Device { adapter: String, what: String },
    #[error("{adapter}: {what}; rasterise at a smaller width or use --device cpu")]
    DeviceCapacity { adapter: String, what: String },
    #[error(
        "pixel {pixel} has region {found}, but the map has {n_regions} regions; create the region map again"
    )]
    Region { pixel: usize, found: u32, n_regions: u32 },
}
