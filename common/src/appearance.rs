//! A Gaussian's appearance in ten bytes: colour and opacity, size, rotation. Renderers of splats take these bytes
//! as they are, so a page draws a cell without decoding it. The byte table is in `docs/formats.md`.

use std::f32::consts::PI;

use glam::{DVec3, Vec3};

use crate::Gaussians;
use crate::gaussians::SH_C0;

pub const BYTES: usize = 10;
/// Natural logarithm of the smallest size.
const LN_SIZE_MIN: f32 = -12.0;
/// Natural logarithm of the largest size.
const LN_SIZE_MAX: f32 = 9.0;
/// Codes of sizes besides 0, which means no extent; neighbouring codes differ by 8.6 %.
const LAST_SIZE_STEP: f32 = 254.0;
const LARGEST: f32 = 255.0;
/// Smaller rotations have no axis.
const LEAST_AXIS: f32 = 1e-6;

/// The appearance of a cell's Gaussians, one column per field.
#[derive(Clone, Copy, Debug)]
pub struct Appearance<'a> {
    /// `[N]`: red, green, blue (`0.5 + SH_C0 * sh_dc`, clamped) and opacity; 0..=255 stands for 0..=1.
    pub colours: &'a [[u8; 4]],
    /// `[N]`: codes of the standard deviations along the Gaussian's own axes, see [`size_code`].
    pub sizes: &'a [[u8; 3]],
    /// `[N]`: codes of the rotations, see [`rotation_code`].
    pub rotations: &'a [[u8; 3]],
}

impl Appearance<'_> {
    /// Returns the largest standard deviation of a Gaussian along its own axes, world units.
    pub fn max_size(&self, index: usize) -> f32 {
        size_of_code(self.sizes[index].into_iter().fold(0, u8::max))
    }

    /// Adds a Gaussian to a scene without harmonics above degree 0.
    pub fn add_to(&self, scene: &mut Gaussians, index: usize, mean_in_world: DVec3) {
        let [r, g, b, opacity] = self.colours[index].map(|code| f32::from(code) / LARGEST);
        scene.means_in_world.push(mean_in_world);
        scene.rotations_wxyz.push(rotation_of_code(self.rotations[index]));
        scene.scales.push(self.sizes[index].map(size_of_code));
        scene.opacities.push(opacity);
        scene.sh_dc.push([r, g, b].map(|c| (c - 0.5) / SH_C0));
    }
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct AppearanceColumns {
    colours: Vec<[u8; 4]>,
    sizes: Vec<[u8; 3]>,
    rotations: Vec<[u8; 3]>,
}

impl AppearanceColumns {
    /// Quantises the appearance of some Gaussians of a scene, in the order of `indices`.
    pub fn of(scene: &Gaussians, indices: &[u32]) -> Self {
        let at = |index: &u32| *index as usize;
        let colour = |index: &u32| {
            let [r, g, b] = scene.rgb_dc(at(index)).map(unit_code);
            [r, g, b, unit_code(scene.opacities[at(index)])]
        };
        Self {
            colours: indices.iter().map(colour).collect(),
            sizes: indices.iter().map(|index| scene.scales[at(index)].map(size_code)).collect(),
            rotations: indices.iter().map(|index| rotation_code(scene.rotations_wxyz[at(index)])).collect(),
        }
    }

    pub fn view(&self) -> Appearance<'_> {
        Appearance { colours: &self.colours, sizes: &self.sizes, rotations: &self.rotations }
    }
}

/// Maps 0..=1 to a byte; other values are clamped, NaN is 0.
fn unit_code(value: f32) -> u8 {
    (value * LARGEST).round() as u8
}

/// Returns the byte of a standard deviation (world units): 0 for 0, else `1 + 254 * (ln size + 12) / 21`, rounded
/// and clamped to 1..=255. Sizes from 6e-6 to 8,000 are off by at most 4.3 %.
pub fn size_code(size: f32) -> u8 {
    if size <= 0.0 || size.is_nan() {
        return 0;
    }
    let step = (size.ln() - LN_SIZE_MIN) / (LN_SIZE_MAX - LN_SIZE_MIN) * LAST_SIZE_STEP;
    (1.0 + step.round()).clamp(1.0, LARGEST) as u8
}

/// Inverse of [`size_code`].
fn size_of_code(code: u8) -> f32 {
    if code == 0 {
        return 0.0;
    }
    ((f32::from(code) - 1.0) / LAST_SIZE_STEP * (LN_SIZE_MAX - LN_SIZE_MIN) + LN_SIZE_MIN).exp()
}

/// Returns the byte of a standard deviation `times` (at least 1) that of another byte.
pub fn larger_size_code(code: u8, times: f32) -> u8 {
    if code == 0 {
        return 0;
    }
    let steps = times.ln() / (LN_SIZE_MAX - LN_SIZE_MIN) * LAST_SIZE_STEP;
    code.saturating_add(steps.round() as u8)
}

/// Returns the bytes of a rotation (unit quaternion): its axis in the octahedral map (Meyer et al. 2010), two
/// bytes, and its angle from 0 to pi, one byte. The decoded rotation is off by at most 1.9 degrees.
pub fn rotation_code([w, x, y, z]: [f32; 4]) -> [u8; 3] {
    // q and -q are one rotation; the one with w >= 0 turns by at most pi.
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    let angle = 2.0 * (w * sign).min(1.0).acos();
    let length = (x * x + y * y + z * z).sqrt();
    let [x, y, z] = if length < LEAST_AXIS { [1.0, 0.0, 0.0] } else { [x, y, z].map(|c| c * sign / length) };
    // The octahedron |x| + |y| + |z| = 1, its lower half folded outward over the upper one.
    let sum = x.abs() + y.abs() + z.abs();
    let (u, v) = (x / sum, y / sum);
    let outward = |of: f32, other: f32| (1.0 - other.abs()) * if of >= 0.0 { 1.0 } else { -1.0 };
    let (u, v) = if z < 0.0 { (outward(u, v), outward(v, u)) } else { (u, v) };
    [unit_code(u * 0.5 + 0.5), unit_code(v * 0.5 + 0.5), unit_code(angle / PI)]
}

/// Inverse of [`rotation_code`].
fn rotation_of_code([u, v, angle]: [u8; 3]) -> [f32; 4] {
    let [u, v] = [u, v].map(|code| f32::from(code) / LARGEST * 2.0 - 1.0);
    let z = 1.0 - u.abs() - v.abs();
    let inward = |of: f32| of - (-z).max(0.0).copysign(of);
    let axis = Vec3::new(inward(u), inward(v), z).normalize();
    let (sin, w) = (f32::from(angle) / LARGEST * 0.5 * PI).sin_cos();
    let [x, y, z] = (axis * sin).to_array();
    [w, x, y, z]
}

#[cfg(test)]
mod tests;
