//! The camera of a view.

use glam::{DAffine3, DMat3};
use slag_common::{Distortion, Gaussians, Intrinsics, View};

use crate::constants::{MAX_IMAGE_PX, MAX_SIDE_PX};

/// A posed pinhole camera at raster resolution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterView {
    /// Rigid transform from world to camera (OpenCV axes).
    pub camera_from_world: DAffine3,
    pub intrinsics: Intrinsics,
}

impl RasterView {
    pub fn of(view: &View) -> Self {
        Self { camera_from_world: view.camera_from_world, intrinsics: view.intrinsics }
    }
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum InputError {
    #[error("scene column {column} has {found} values, expected {expected}; read the scene again")]
    ColumnLength { column: &'static str, expected: usize, found: usize },
    #[error("the scene has {found} Gaussians, expected at most {max}; split it into parts", max = u32::MAX)]
    SceneSize { found: usize },
    #[error("spherical harmonics of degree {found}, expected at most 3; convert the scene")]
    ShDegree { found: u8 },
    #[error(
        "image of {width_px} x {height_px} px, expected 1 to {max} px in total, and sides of at most {MAX_SIDE_PX} px; choose \
         another raster width",
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
}

pub fn check_scene(scene: &Gaussians) -> Result<(), InputError> {
    let n = scene.len();
    if u32::try_from(n).is_err() {
        return Err(InputError::SceneSize { found: n });
    }
    if scene.sh_degree > 3 {
        return Err(InputError::ShDegree { found: scene.sh_degree });
    }
    let rest = n * Gaussians::sh_rest_per_channel(scene.sh_degree) * 3;
    for (column, found, expected) in [
        ("rotations_wxyz", scene.rotations_wxyz.len(), n),
        ("scales", scene.scales.len(), n),
        ("opacities", scene.opacities.len(), n),
        ("sh_dc", scene.sh_dc.len(), n),
        ("sh_rest", scene.sh_rest.len(), rest),
    ] {
        if found != expected {
            return Err(InputError::ColumnLength { column, expected, found });
        }
    }
    Ok(())
}

/// Checks that a view is a pinhole camera with a rigid pose and pixels.
pub fn check_view(view: &RasterView) -> Result<(), InputError> {
    let Intrinsics { width_px, height_px, focal_x_px, focal_y_px, centre_x_px, centre_y_px, distortion } =
        view.intrinsics;
    let n_px = u64::from(width_px) * u64::from(height_px);
    if !(1..=MAX_IMAGE_PX).contains(&n_px) || width_px.max(height_px) > MAX_SIDE_PX {
        return Err(InputError::ImageSize { width_px, height_px });
    }
    if distortion != Distortion::None {
        return Err(InputError::Distorted);
    }
    let is_focal = |f: f64| f.is_finite() && f > 0.0;
    if !(is_focal(focal_x_px) && is_focal(focal_y_px) && centre_x_px.is_finite() && centre_y_px.is_finite()) {
        return Err(InputError::Camera {
            focal_px: [focal_x_px, focal_y_px],
            centre_px: [centre_x_px, centre_y_px],
        });
    }
    // Poses are often f32 or rounded text: a deviation of 1e-3 is still a rotation, a mirror or scale is not.
    let rotation = view.camera_from_world.matrix3;
    let excess = rotation.transpose() * rotation - DMat3::IDENTITY;
    let off =
        excess.to_cols_array().into_iter().fold(0.0, |m: f64, e| if e.abs() <= m { m } else { e.abs() });
    if !view.camera_from_world.is_finite() {
        return Err(InputError::Pose { off: f64::NAN });
    }
    if off > 1e-3 || rotation.determinant() < 0.0 {
        return Err(InputError::Pose { off: if off > 1e-3 { off } else { f64::INFINITY } });
    }
    Ok(())
}
