//! Refuses scenes in units so large that the near plane cuts what views show.

use glam::DVec3;
use slag_common::Gaussians;
use slag_math::stats::{Rank, quantile};
use slag_raster::RasterView;
use slag_raster::constants::NEAR_Z;

use super::RasterError;

/// Share of the Gaussians before cameras that may be nearer than the near plane; ordinary scenes have none there.
const MOST_CUT: f64 = 0.02;
/// Median depth from which the unit is not at fault, near planes.
const DEEP: f64 = 20.0;
/// Gaussians and views that tell enough, and depths below which nothing is told.
const ENOUGH_GAUSSIANS: usize = 20_000;
const ENOUGH_VIEWS: usize = 20;
const FEW_DEPTHS: usize = 1000;

/// # Errors
/// [`RasterError::NearPlane`].
pub(crate) fn check_near_plane(scene: &Gaussians, views: &[RasterView]) -> Result<(), RasterError> {
    let stride = scene.len().div_ceil(ENOUGH_GAUSSIANS).max(1);
    let means: Vec<DVec3> = (0..scene.len())
        .step_by(stride)
        .filter(|i| scene.is_usable(*i))
        .map(|i| scene.means_in_world[i])
        .collect();
    let mut depths: Vec<f64> = Vec::new();
    for view in views.iter().step_by(views.len().div_ceil(ENOUGH_VIEWS).max(1)) {
        let in_camera = means.iter().map(|mean| view.camera_from_world.transform_point3(*mean));
        depths.extend(in_camera.filter(|at| is_in_image(view, *at)).map(|at| at.z));
    }
    let cut_share = depths.iter().filter(|z| **z < NEAR_Z).count() as f64 / depths.len().max(1) as f64;
    match quantile(&mut depths, 500, Rank::After) {
        Some(depth) if depths.len() >= FEW_DEPTHS && cut_share > MOST_CUT && depth < DEEP * NEAR_Z => {
            let factor = 10.0_f64.powf((1.0 / depth).log10().ceil());
            Err(RasterError::NearPlane { depth, cut_share, factor })
        }
        _ => Ok(()),
    }
}

fn is_in_image(view: &RasterView, at: DVec3) -> bool {
    let camera = &view.intrinsics;
    let [u, v] = camera.pixel_from_distorted([at.x / at.z, at.y / at.z]);
    at.z > 0.0
        && (0.0..f64::from(camera.width_px)).contains(&u)
        && (0.0..f64::from(camera.height_px)).contains(&v)
}

#[cfg(test)]
mod tests {
    use glam::DAffine3;

    use super::*;
    use crate::raster::pinhole;
    use slag_test_support::assert_error;

    /// By hand: depths of 0.1 to 1 have their median at 0.55; a thirtieth of that is 0.0183, a fifth of it nearer
    /// than 0.01.
    #[test]
    fn scenes_in_large_units_are_refused_with_a_factor() {
        let view = RasterView { camera_from_world: DAffine3::IDENTITY, intrinsics: pinhole([64, 48], 50.0) };
        let check = |unit: f64| {
            let means = (0..2000).map(|i| DVec3::Z * unit * (0.1 + 0.9 * f64::from(i) / 2000.0)).collect();
            check_near_plane(&Gaussians::balls(means, 0.001), &[view])
        };
        assert_eq!((check(1.0), check(0.1)), (Ok(()), Ok(())));
        assert_error(check(1.0 / 30.0), &["22 %", "splat 100 times"]);
    }
}
