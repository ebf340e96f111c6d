//! Projects Gaussians to ellipses on the screen.

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;
use slag_common::{Gaussians, Intrinsics};

use super::RasterView;
use super::constants::{
    COVARIANCE_BLUR_PX2, FAR_Z, FOV_MARGIN, MAX_VARIANCE_PX2, MIN_ALPHA, NEAR_Z, REACH2_MARGIN,
};

/// A Gaussian on the screen.
///
/// With `d = pixel centre - mean_px`, `u = inv_width * (d.x - slope * d.y)` and `v = inv_height *
/// d.y`, the power is `(u^2 + v^2) / 2`: the Cholesky factor of the inverse covariance. A sum of
/// squares loses no digits where needles cancel in `a dx^2 + 2 b dx dy + c dy^2`.
/// 56 bytes: tiles read these at random, and a cache line is 64.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScreenGaussian {
    /// Index in the scene.
    pub gaussian: u32,
    /// Camera z, world units.
    pub depth: f32,
    /// Opacity.
    pub opacity: f32,
    /// `u^2 + v^2` within which alpha may count.
    pub reach2: f32,
    /// Centre on the screen, pixels.
    pub mean_px: DVec2,
    /// 1 / standard deviation along x at fixed y, 1/px.
    pub inv_width: f64,
    /// Shift of the ellipse's row centres, pixels of x a pixel of y.
    pub slope: f64,
    /// 1 / standard deviation along y, 1/px.
    pub inv_height: f64,
}

impl ScreenGaussian {
    /// Returns half the size of the box around the footprint, pixels.
    pub fn extent_px(&self) -> DVec2 {
        let cov_yy = self.inv_height.powi(-2);
        let cov_xx = self.inv_width.powi(-2) + self.slope * self.slope * cov_yy;
        DVec2::new(cov_xx, cov_yy).map(|v| (f64::from(self.reach2) * v).sqrt())
    }

    /// Returns the highest and lowest y of the footprint, pixels.
    pub fn y_range_px(&self) -> [f64; 2] {
        let extent = f64::from(self.reach2).sqrt() / self.inv_height;
        [self.mean_px.y - extent, self.mean_px.y + extent]
    }

    /// Returns the pixels `first..=last` along one axis whose centres lie in `[low, high]` and in the
    /// image; `None` if there is none.
    pub fn pixels_within(low: f64, high: f64, size_px: u32) -> Option<(u32, u32)> {
        let first = (low - 0.5).ceil().max(0.0);
        let last = (high - 0.5).floor().min(f64::from(size_px) - 1.0);
        (first <= last).then_some((first as u32, last as u32))
    }
}

/// What of a scene a view can see.
#[derive(Clone, Debug, Default)]
pub struct Projection {
    /// Gaussians with at least one pixel centre of the image in the box around their footprint, in
    /// the scene's order.
    pub visible: Vec<ScreenGaussian>,
    /// Gaussians that cannot be drawn.
    pub unusable: usize,
}

/// Gaussians a task of the thread pool; enough to hide its cost.
const CHUNK: usize = 4096;

/// Projects a scene whose columns fit each other.
pub fn project(scene: &Gaussians, view: &RasterView) -> Projection {
    let parts: Vec<Projection> = (0..scene.len().div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let mut part = Projection::default();
            for index in chunk * CHUNK..((chunk + 1) * CHUNK).min(scene.len()) {
                if !scene.is_usable(index) {
                    part.unusable += 1;
                    continue;
                }
                match project_one(scene, index, view) {
                    Ok(Some(on_screen)) => part.visible.push(on_screen),
                    Ok(None) => {}
                    Err(Unrepresentable) => part.unusable += 1,
                }
            }
            part
        })
        .collect();
    Projection {
        unusable: parts.iter().map(|p| p.unusable).sum(),
        visible: parts.into_iter().flat_map(|p| p.visible).collect(),
    }
}

/// Returns the squared Mahalanobis distance within which a Gaussian's alpha may reach 1/255.
pub fn reach2(opacity: f32) -> f32 {
    ((2.0 * (255.0 * f64::from(opacity)).ln()).max(0.0) + REACH2_MARGIN) as f32
}

/// The projected covariance is beyond the range of the pixels' arithmetic.
struct Unrepresentable;

/// Projects one usable Gaussian; `None` where it is culled.
fn project_one(
    scene: &Gaussians,
    index: usize,
    view: &RasterView,
) -> Result<Option<ScreenGaussian>, Unrepresentable> {
    let opacity = scene.opacities[index];
    let mean = view.camera_from_world.transform_point3(scene.means_in_world[index]);
    if opacity < MIN_ALPHA || !(NEAR_Z..=FAR_Z).contains(&mean.z) {
        return Ok(None);
    }
    let camera = &view.intrinsics;
    let mean_px = DVec2::new(
        camera.focal_x_px * mean.x / mean.z + camera.centre_x_px,
        camera.focal_y_px * mean.y / mean.z + camera.centre_y_px,
    );
    let [row_x, row_y] = jacobian_rows(mean, camera);
    let [w, x, y, z] = scene.rotations_wxyz[index].map(f64::from);
    let world_from_axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scales = DVec3::from_array(scene.scales[index].map(f64::from));
    let camera_from_unit = view.camera_from_world.matrix3 * world_from_axes * DMat3::from_diagonal(scales);
    // Rows of M, with covariance = M M' + blur I.
    let m_x = camera_from_unit.transpose() * row_x;
    let m_y = camera_from_unit.transpose() * row_y;
    let cov_xx = m_x.length_squared() + COVARIANCE_BLUR_PX2;
    let cov_yy = m_y.length_squared() + COVARIANCE_BLUR_PX2;
    let cov_xy = m_x.dot(m_y);
    if !(cov_xx <= MAX_VARIANCE_PX2 && cov_yy <= MAX_VARIANCE_PX2 && mean_px.is_finite()) {
        return Err(Unrepresentable);
    }
    // |m_x|^2 |m_y|^2 - (m_x . m_y)^2 = |m_x x m_y|^2 (Lagrange): exact for needles, and above 0.
    let det = m_x.cross(m_y).length_squared() + COVARIANCE_BLUR_PX2 * (cov_xx + cov_yy)
        - COVARIANCE_BLUR_PX2 * COVARIANCE_BLUR_PX2;
    let on_screen = ScreenGaussian {
        gaussian: index as u32,
        depth: mean.z as f32,
        opacity,
        reach2: reach2(opacity),
        mean_px,
        inv_width: (cov_yy / det).sqrt(),
        slope: cov_xy / cov_yy,
        inv_height: cov_yy.sqrt().recip(),
    };
    let extent_px = on_screen.extent_px();
    let (low, high) = (mean_px - extent_px, mean_px + extent_px);
    let in_image = ScreenGaussian::pixels_within(low.x, high.x, camera.width_px)
        .and(ScreenGaussian::pixels_within(low.y, high.y, camera.height_px));
    Ok(in_image.map(|_| on_screen))
}

/// Returns the rows of the Jacobian of the pinhole projection (Zwicker et al., EWA splatting, 2001),
/// px per world unit, taken inside a slightly widened field of view.
fn jacobian_rows(mean: DVec3, camera: &Intrinsics) -> [DVec3; 2] {
    let (width, height) = (f64::from(camera.width_px), f64::from(camera.height_px));
    let limited = |tangent: f64, focal: f64, centre: f64, size: f64| {
        let margin = FOV_MARGIN * 0.5 * size / focal;
        tangent.max(-centre / focal - margin).min((size - centre) / focal + margin)
    };
    let tan_x = limited(mean.x / mean.z, camera.focal_x_px, camera.centre_x_px, width);
    let tan_y = limited(mean.y / mean.z, camera.focal_y_px, camera.centre_y_px, height);
    [
        DVec3::new(1.0, 0.0, -tan_x) * (camera.focal_x_px / mean.z),
        DVec3::new(0.0, 1.0, -tan_y) * (camera.focal_y_px / mean.z),
    ]
}
