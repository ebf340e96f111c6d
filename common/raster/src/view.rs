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

/// Why a scene or a view cannot be drawn, and what to do.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("{0}")]
pub struct InputError(String);

pub fn check_scene(scene: &Gaussians) -> Result<(), InputError> {
    let n = scene.len();
    let refuse = |fault: String| Err(InputError(fault));
    if u32::try_from(n).is_err() {
        return refuse(format!(
            "the scene has {n} Gaussians, expected at most {}; split it into parts",
            u32::MAX
        ));
    }
    if scene.sh_degree > 3 {
        let degree = scene.sh_degree;
        return refuse(format!(
            "spherical harmonics of degree {degree}, expected at most 3; convert the scene"
        ));
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
            let fault = format!("scene column {column} has {found} values, expected {expected}");
            return refuse(format!("{fault}; read the scene again"));
        }
    }
    Ok(())
}

/// Checks that a view is a pinhole camera with a rigid pose and pixels.
pub fn check_view(view: &RasterView) -> Result<(), InputError> {
    let Intrinsics { width_px, height_px, focal_x_px, focal_y_px, centre_x_px, centre_y_px, distortion } =
        view.intrinsics;
    let refuse = |fault: String| Err(InputError(fault));
    let n_px = u64::from(width_px) * u64::from(height_px);
    if !(1..=MAX_IMAGE_PX).contains(&n_px) || width_px.max(height_px) > MAX_SIDE_PX {
        return refuse(format!(
            "image of {width_px} x {height_px} px, expected 1 to {MAX_IMAGE_PX} px in total, and sides of at most \
             {MAX_SIDE_PX} px; choose another raster width"
        ));
    }
    if distortion != Distortion::None {
        return refuse(
            "the camera has lens distortion; undistort the image and use its pinhole camera".into(),
        );
    }
    let is_focal = |f: f64| f.is_finite() && f > 0.0;
    if !(is_focal(focal_x_px) && is_focal(focal_y_px) && centre_x_px.is_finite() && centre_y_px.is_finite()) {
        let (focal_px, centre_px) = ([focal_x_px, focal_y_px], [centre_x_px, centre_y_px]);
        return refuse(format!(
            "invalid camera: focal lengths {focal_px:?} px, principal point {centre_px:?} px; correct the intrinsics"
        ));
    }
    // Poses are often f32 or rounded text: a deviation of 1e-3 is still a rotation, a mirror or scale is not.
    let rotation = view.camera_from_world.matrix3;
    let excess = rotation.transpose() * rotation - DMat3::IDENTITY;
    let off =
        excess.to_cols_array().into_iter().fold(0.0, |m: f64, e| if e.abs() <= m { m } else { e.abs() });
    let off = match view.camera_from_world.is_finite() {
        false => f64::NAN,
        true if off > 1e-3 => off,
        true if rotation.determinant() < 0.0 => f64::INFINITY,
        true => return Ok(()),
    };
    refuse(format!("the pose is not rigid (deviation {off:e}); correct the rotation of the view"))
}
