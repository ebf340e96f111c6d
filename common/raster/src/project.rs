//! Projects Gaussians to ellipses on the screen.

use bytemuck::Zeroable;
use glam::{DMat3, DQuat, DVec2, DVec3, Vec3};
use rayon::prelude::*;
use slag_common::gaussians::SH_C0;
use slag_common::{Gaussians, Intrinsics};

use crate::buckets::concat;
use crate::constants::{
    COVARIANCE_BLUR_PX2, FAR_Z, FOV_MARGIN, MAX_VARIANCE_PX2, MIN_ALPHA, NEAR_Z, REACH2_MARGIN,
};
use crate::view::RasterView;

/// A Gaussian on the screen.
///
/// With `d = pixel centre - mean_px`, `u = inv_width * (d.x - slope * d.y)` and `v = inv_height * d.y`, the
/// exponent is `(u^2 + v^2) / 2`: the fields are the Cholesky factor of the inverse covariance. A sum of squares
/// loses no digits, whereas the terms of `a dx^2 + 2 b dx dy + c dy^2` cancel for needles. The size is 56 bytes,
/// because tiles access Gaussians at random and a cache line has 64.
#[derive(Clone, Copy, Debug, Default, PartialEq, Zeroable)]
pub struct ScreenGaussian {
    /// Index in the scene.
    pub gaussian: u32,
    /// Camera z, world units.
    pub depth: f32,
    pub opacity: f32,
    /// Largest `u^2 + v^2` at which alpha may reach its minimum.
    pub reach2: f32,
    /// Centre on the screen, pixels.
    pub mean_px: DVec2,
    /// 1 / standard deviation along x at fixed y, 1/px.
    pub inv_width: f64,
    /// Shift of the centre of the ellipse per row, pixels of x per pixel of y.
    pub slope: f64,
    /// 1 / standard deviation along y, 1/px.
    pub inv_height: f64,
}

impl ScreenGaussian {
    /// Half the size of the footprint's bounding box, pixels.
    pub fn extent_px(&self) -> DVec2 {
        let cov_yy = self.inv_height.powi(-2);
        let cov_xx = self.inv_width.powi(-2) + self.slope * self.slope * cov_yy;
        DVec2::new(cov_xx, cov_yy).map(|v| (f64::from(self.reach2) * v).sqrt())
    }

    /// Lowest and highest y of the footprint, pixels.
    pub fn y_range_px(&self) -> [f64; 2] {
        let extent = f64::from(self.reach2).sqrt() / self.inv_height;
        [self.mean_px.y - extent, self.mean_px.y + extent]
    }

    /// Returns the pixels `first..=last` of an axis whose centres are in `[low, high]` and in the image, if any.
    pub fn pixels_within(low: f64, high: f64, size_px: u32) -> Option<(u32, u32)> {
        let first = (low - 0.5).max(0.0);
        let last = (high - 0.5).min(f64::from(size_px) - 1.0);
        if first > last {
            return None;
        }
        // Truncation is a single instruction; `ceil` and `floor` may be calls.
        let (below, last) = (first as u32, last as u32);
        let first = below + u32::from(f64::from(below) < first);
        (first <= last).then_some((first, last))
    }
}

#[derive(Clone, Debug, Default)]
pub struct Projection {
    /// In scene order: those with a pixel centre of the image in the bounding box of their footprint.
    pub visible: Vec<ScreenGaussian>,
    pub unusable: usize,
}

/// Gaussians per task; enough to hide its overhead.
const CHUNK: usize = 4096;

/// A scene with precomputed sizes, to exclude invisible Gaussians fast.
pub struct PreparedScene<'s> {
    /// Its columns have matching lengths.
    pub scene: &'s Gaussians,
    sizes: Vec<Size>,
    unusable: usize,
}

#[derive(Clone, Copy, Zeroable)]
struct Size {
    /// Largest standard deviation, world units.
    max_scale: f32,
    /// Largest `u^2 + v^2` at which alpha may reach its minimum; negative if the Gaussian is never drawn.
    reach2: f32,
}

impl<'s> PreparedScene<'s> {
    pub const BYTES_PER_GAUSSIAN: usize = size_of::<Size>();

    pub fn new(scene: &'s Gaussians) -> Self {
        let mut sizes: Vec<Size> = bytemuck::zeroed_vec(scene.len());
        let unusable = sizes
            .par_chunks_mut(CHUNK)
            .enumerate()
            .map(|(chunk, sizes)| {
                let mut unusable = 0;
                for (size, index) in sizes.iter_mut().zip(chunk * CHUNK..) {
                    let usable = scene.is_usable(index);
                    unusable += usize::from(!usable);
                    let opacity = scene.opacities[index];
                    let drawn = usable && opacity >= MIN_ALPHA;
                    size.max_scale = scene.scales[index].into_iter().fold(0.0, f32::max);
                    size.reach2 = if drawn { reach2(opacity) } else { -1.0 };
                }
                unusable
            })
            .sum();
        Self { scene, sizes, unusable }
    }

    pub fn project(&self, view: &RasterView) -> Projection {
        let bounds = Bounds::new(view);
        let parts: Vec<(Vec<ScreenGaussian>, usize)> = self
            .sizes
            .par_chunks(CHUNK)
            .enumerate()
            .map(|(chunk, sizes)| {
                let (mut visible, mut unusable) = (Vec::new(), 0);
                for (&size, index) in sizes.iter().zip(chunk * CHUNK..) {
                    if size.reach2 < 0.0 {
                        continue;
                    }
                    let mean = view.camera_from_world.transform_point3(self.scene.means_in_world[index]);
                    if bounds.exclude(mean, size) {
                        continue;
                    }
                    match project_one(self.scene, index, size, mean, view) {
                        Ok(Some(on_screen)) => visible.push(on_screen),
                        Ok(None) => {}
                        Err(Unrepresentable) => unusable += 1,
                    }
                }
                (visible, unusable)
            })
            .collect();
        let (visible, unusable): (Vec<_>, Vec<usize>) = parts.into_iter().unzip();
        let unusable = self.unusable + unusable.iter().sum::<usize>();
        Projection { visible: concat(&visible), unusable }
    }
}

/// The frustum of a view, for a fast conservative visibility test.
struct Bounds {
    focal_px: DVec2,
    /// Distance from the centre of the first pixel to the principal point, pixels.
    before_px: DVec2,
    /// Distance from the principal point to the centre of the last pixel, pixels.
    after_px: DVec2,
    /// Upper bound of the screen pixels per world unit at z = 1.
    stretch_px: DVec2,
}

impl Bounds {
    /// Factor on the extent: rotations are orthonormal to 1e-3 only, and sums are rounded.
    const SLACK: f64 = 1.002;
    /// Extents below this have a covariance within [`MAX_VARIANCE_PX2`] for certain.
    const MAX_EXTENT_PX: f64 = 1e9;

    fn new(view: &RasterView) -> Self {
        let camera = &view.intrinsics;
        let [tan_x, tan_y] = tangent_limits(camera).map(|[low, high]| high.max(-low));
        let focal_px = DVec2::new(camera.focal_x_px, camera.focal_y_px);
        let before_px = DVec2::new(camera.centre_x_px, camera.centre_y_px) - 0.5;
        Self {
            focal_px,
            before_px,
            after_px: DVec2::new(camera.width_px.into(), camera.height_px.into()) - 1.0 - before_px,
            stretch_px: focal_px * DVec2::new(tan_x.hypot(1.0), tan_y.hypot(1.0)),
        }
    }

    /// Returns whether the footprint of a Gaussian with this mean (camera frame) certainly contains no pixel
    /// centre. All lengths are multiplied by z, which saves divisions.
    fn exclude(&self, mean: DVec3, size: Size) -> bool {
        if !(NEAR_Z..=FAR_Z).contains(&mean.z) {
            return true;
        }
        let reach = f64::from(size.reach2).sqrt() * Self::SLACK;
        // The square root of a sum is at most the sum of the square roots.
        let extent =
            (self.stretch_px * f64::from(size.max_scale) + COVARIANCE_BLUR_PX2.sqrt() * mean.z) * reach;
        let offset = self.focal_px * mean.truncate();
        let beyond = (offset + self.before_px * mean.z + extent).cmplt(DVec2::ZERO)
            | (offset - self.after_px * mean.z - extent).cmpgt(DVec2::ZERO);
        let certain = extent.max_element() < Self::MAX_EXTENT_PX * mean.z && offset.is_finite();
        beyond.any() && certain
    }
}

/// Squared Mahalanobis distance within which alpha may reach 1/255.
pub fn reach2(opacity: f32) -> f32 {
    ((2.0 * (255.0 * f64::from(opacity)).ln()).max(0.0) + REACH2_MARGIN) as f32
}

/// The projected covariance exceeds the range of the pixels' arithmetic.
struct Unrepresentable;

/// Projects a usable Gaussian with its mean in the camera frame; `None` if it is culled.
fn project_one(
    scene: &Gaussians,
    index: usize,
    size: Size,
    mean: DVec3,
    view: &RasterView,
) -> Result<Option<ScreenGaussian>, Unrepresentable> {
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
    // Rows of M, where the covariance is M M' + blur I.
    let m_x = camera_from_unit.transpose() * row_x;
    let m_y = camera_from_unit.transpose() * row_y;
    let cov_xx = m_x.length_squared() + COVARIANCE_BLUR_PX2;
    let cov_yy = m_y.length_squared() + COVARIANCE_BLUR_PX2;
    let cov_xy = m_x.dot(m_y);
    if !(cov_xx <= MAX_VARIANCE_PX2 && cov_yy <= MAX_VARIANCE_PX2 && mean_px.is_finite()) {
        return Err(Unrepresentable);
    }
    // Lagrange's identity |m_x|^2 |m_y|^2 - (m_x . m_y)^2 = |m_x x m_y|^2 is accurate for needles, and positive.
    let det = m_x.cross(m_y).length_squared() + COVARIANCE_BLUR_PX2 * (cov_xx + cov_yy)
        - COVARIANCE_BLUR_PX2 * COVARIANCE_BLUR_PX2;
    let on_screen = ScreenGaussian {
        gaussian: index as u32,
        depth: mean.z as f32,
        opacity: scene.opacities[index],
        reach2: size.reach2,
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

/// Returns the rows of the Jacobian of the pinhole projection (Zwicker et al., EWA splatting, 2001), px per world
/// unit, evaluated within a slightly widened field of view.
fn jacobian_rows(mean: DVec3, camera: &Intrinsics) -> [DVec3; 2] {
    let [limit_x, limit_y] = tangent_limits(camera);
    let tan_x = (mean.x / mean.z).max(limit_x[0]).min(limit_x[1]);
    let tan_y = (mean.y / mean.z).max(limit_y[0]).min(limit_y[1]);
    [
        DVec3::new(1.0, 0.0, -tan_x) * (camera.focal_x_px / mean.z),
        DVec3::new(0.0, 1.0, -tan_y) * (camera.focal_y_px / mean.z),
    ]
}

/// Lowest and highest tangents in x and y at which the Jacobian is evaluated.
fn tangent_limits(camera: &Intrinsics) -> [[f64; 2]; 2] {
    let limits = |focal: f64, centre: f64, size: u32| {
        let margin = FOV_MARGIN * 0.5 * f64::from(size) / focal;
        [-centre / focal - margin, (f64::from(size) - centre) / focal + margin]
    };
    [
        limits(camera.focal_x_px, camera.centre_x_px, camera.width_px),
        limits(camera.focal_y_px, camera.centre_y_px, camera.height_px),
    ]
}

/// Factors of the real spherical harmonics of degree 1 to 3, in the order and with the signs of 3DGS (Kerbl et al.
/// 2023), after the polynomials of Ramamoorthi and Hanrahan.
const SH_C1: f32 = 0.488_602_51;
const SH_C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
const SH_C3: [f32; 7] =
    [-0.590_043_6, 2.890_611_4, -0.457_045_8, 0.373_176_33, -0.457_045_8, 1.445_305_7, -0.590_043_6];
/// Number of coefficients above degree 0, for degree 3.
const MAX_REST: usize = 15;

pub fn colours(scene: &Gaussians, visible: &[ScreenGaussian], position_in_world: DVec3) -> Vec<[f32; 3]> {
    visible
        .par_iter()
        .map(|on_screen| colour(scene, on_screen.gaussian as usize, position_in_world))
        .collect()
}

/// Colour of a Gaussian seen from a camera: `max(0, SH(direction) + 0.5)`.
pub fn colour(scene: &Gaussians, index: usize, position_in_world: DVec3) -> [f32; 3] {
    let n_rest = Gaussians::sh_rest_per_channel(scene.sh_degree).min(MAX_REST);
    let mut rgb = scene.sh_dc[index].map(|c| 0.5 + SH_C0 * c);
    if n_rest > 0 {
        let direction = (scene.means_in_world[index] - position_in_world).normalize_or_zero();
        let basis = rest_basis(direction.as_vec3());
        let coefficients = &scene.sh_rest[index * n_rest * 3..][..n_rest * 3];
        for (value, coefficient) in basis.iter().zip(coefficients.chunks_exact(3)) {
            rgb = std::array::from_fn(|c| rgb[c] + value * coefficient[c]);
        }
    }
    // One invalid coefficient must not spoil the picture.
    rgb.map(|c| if c.is_finite() { c.max(0.0) } else { 0.0 })
}

/// Returns the basis functions of degree 1 to 3 for a unit direction.
fn rest_basis(Vec3 { x, y, z }: Vec3) -> [f32; MAX_REST] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        -SH_C1 * y,
        SH_C1 * z,
        -SH_C1 * x,
        SH_C2[0] * x * y,
        SH_C2[1] * y * z,
        SH_C2[2] * (2.0 * zz - xx - yy),
        SH_C2[3] * x * z,
        SH_C2[4] * (xx - yy),
        SH_C3[0] * y * (3.0 * xx - yy),
        SH_C3[1] * x * y * z,
        SH_C3[2] * y * (4.0 * zz - xx - yy),
        SH_C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        SH_C3[4] * x * (4.0 * zz - xx - yy),
        SH_C3[5] * z * (xx - yy),
        SH_C3[6] * x * (xx - 3.0 * yy),
    ]
}
