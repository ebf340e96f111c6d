//! Colours of Gaussians seen from a camera: real spherical harmonics up to degree 3.

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use slag_common::Gaussians;
use slag_common::gaussians::SH_C0;

use crate::project::ScreenGaussian;

/// Factors of the real spherical harmonics of degree 1, 2 and 3, in the order and with the signs of 3DGS (Kerbl et
/// al. 2023), which follows the polynomials of Ramamoorthi and Hanrahan.
const SH_C1: f32 = 0.488_602_51;
const SH_C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
const SH_C3: [f32; 7] =
    [-0.590_043_6, 2.890_611_4, -0.457_045_8, 0.373_176_33, -0.457_045_8, 1.445_305_7, -0.590_043_6];
/// Number of coefficients above degree 0, for degree 3.
const MAX_REST: usize = 15;

/// Returns the RGB colour of each visible Gaussian seen from a camera.
pub fn colours(scene: &Gaussians, visible: &[ScreenGaussian], position_in_world: DVec3) -> Vec<[f32; 3]> {
    visible
        .par_iter()
        .map(|on_screen| colour(scene, on_screen.gaussian as usize, position_in_world))
        .collect()
}

/// Returns the RGB colour of a Gaussian seen from a camera: `max(0, SH(direction) + 0.5)`.
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
