//! Validation of scenes, views and region maps.

use glam::DMat3;
use slag_common::{Distortion, Gaussians, Intrinsics};

use super::constants::MAX_IMAGE_PX;
use super::error::RasterError;
use super::view::RasterView;
use crate::masks::{NO_REGION, RegionMap};

/// Checks that the columns of a scene have matching lengths.
pub(super) fn check_scene(scene: &Gaussians) -> Result<(), RasterError> {
    let n = scene.len();
    if u32::try_from(n).is_err() {
        return Err(RasterError::SceneSize { found: n });
    }
    if scene.sh_degree > 3 {
        return Err(RasterError::ShDegree { found: scene.sh_degree });
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
            return Err(RasterError::ColumnLength { column, expected, found });
        }
    }
    Ok(())
}

/// Checks that a view is a pinhole camera with a rigid pose and pixels.
pub(super) fn check_view(view: &RasterView) -> Result<(), RasterError> {
    let Intrinsics { width_px, height_px, focal_x_px, focal_y_px, centre_x_px, centre_y_px, distortion } =
        view.intrinsics;
    if !(1..=MAX_IMAGE_PX).contains(&(u64::from(width_px) * u64::from(height_px))) {
        return Err(RasterError::ImageSize { width_px, height_px });
    }
    if distortion != Distortion::None {
        return Err(RasterError::Distorted);
    }
    let is_focal = |f: f64| f.is_finite() && f > 0.0;
    if !(is_focal(focal_x_px) && is_focal(focal_y_px) && centre_x_px.is_finite() && centre_y_px.is_finite()) {
        return Err(RasterError::Camera {
            focal_px: [focal_x_px, focal_y_px],
            centre_px: [centre_x_px, centre_y_px],
        });
    }
    // Poses are often stored as f32 or rounded text. A deviation of 1e-3 still is a rotation; a mirror or scale is
    // not.
    let rotation = view.camera_from_world.matrix3;
    let excess = rotation.transpose() * rotation - DMat3::IDENTITY;
    let off =
        excess.to_cols_array().into_iter().fold(0.0, |m: f64, e| if e.abs() <= m { m } else { e.abs() });
    if !view.camera_from_world.is_finite() {
        return Err(RasterError::Pose { off: f64::NAN });
    }
    if off > 1e-3 || rotation.determinant() < 0.0 {
        return Err(RasterError::Pose { off: if off > 1e-3 { off } else { f64::INFINITY } });
    }
    Ok(())
}

/// Checks that a region map has the size of the view and no region number out of range.
pub(super) fn check_regions(regions: &RegionMap, intrinsics: &Intrinsics) -> Result<(), RasterError> {
    let expected_px = [intrinsics.width_px, intrinsics.height_px];
    let found_px = [regions.width_px, regions.height_px];
    let found_values = regions.region_of_pixel.len();
    if found_px != expected_px || found_values as u64 != u64::from(found_px[0]) * u64::from(found_px[1]) {
        return Err(RasterError::RegionMapSize { expected_px, found_px, found_values });
    }
    let n_regions = regions.n_regions;
    match regions.region_of_pixel.iter().position(|&r| r >= n_regions && r != NO_REGION) {
        Some(pixel) => Err(RasterError::Region { pixel, found: regions.region_of_pixel[pixel], n_regions }),
        None => Ok(()),
    }
}
