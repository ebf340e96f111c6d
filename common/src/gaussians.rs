//! The decoded Gaussians of a scene, common to all splat formats.

use glam::DVec3;

/// Zeroth spherical-harmonic basis function, 1 / (2 sqrt(pi)).
pub const SH_C0: f32 = 0.282_094_79;

/// Largest coordinate of a mean; keeps box sizes and squared distances finite in f64.
const MAX_COORDINATE: f64 = f32::MAX as f64;

/// 3D Gaussians, one column per field, [`Gaussians::len`] rows each.
///
/// Values are decoded: opacities are linear (not logits), scales are standard deviations (not logs), rotations are
/// unit quaternions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    pub means_in_world: Vec<DVec3>,
    /// Rotations (world from the Gaussian's own axes), `wxyz`, unit length.
    pub rotations_wxyz: Vec<[f32; 4]>,
    /// Standard deviations along the Gaussian's own axes, world units.
    pub scales: Vec<[f32; 3]>,
    /// Opacities, 0..=1.
    pub opacities: Vec<f32>,
    /// Spherical-harmonic coefficients of degree 0; colour is `0.5 + SH_C0 * sh_dc`.
    pub sh_dc: Vec<[f32; 3]>,
    /// Higher coefficients `[N][(degree + 1)^2 - 1][3]`, RGB innermost; empty at degree 0.
    pub sh_rest: Vec<f32>,
    /// Degree of the spherical harmonics, 0..=3.
    pub sh_degree: u8,
}

impl Gaussians {
    /// Returns grey, half opaque balls.
    pub fn balls(means_in_world: Vec<DVec3>, scale: f32) -> Self {
        let n = means_in_world.len();
        Self {
            means_in_world,
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[scale; 3]; n],
            opacities: vec![0.5; n],
            sh_dc: vec![[0.0; 3]; n],
            ..Self::default()
        }
    }

    pub fn len(&self) -> usize {
        self.means_in_world.len()
    }

    pub fn is_empty(&self) -> bool {
        self.means_in_world.is_empty()
    }

    pub fn len_bytes(&self) -> u64 {
        let Self { means_in_world, rotations_wxyz, scales, opacities, sh_dc, sh_rest, sh_degree: _ } = self;
        let shape = size_of_val(&**means_in_world) + size_of_val(&**rotations_wxyz) + size_of_val(&**scales);
        let colour = size_of_val(&**opacities) + size_of_val(&**sh_dc) + size_of_val(&**sh_rest);
        (shape + colour) as u64
    }

    /// Returns the number of higher coefficients per colour channel of a Gaussian.
    pub fn sh_rest_per_channel(degree: u8) -> usize {
        (usize::from(degree) + 1).pow(2) - 1
    }

    /// Returns the colour of degree 0, not clamped.
    pub fn rgb_dc(&self, index: usize) -> [f32; 3] {
        self.sh_dc[index].map(|c| 0.5 + SH_C0 * c)
    }

    /// Returns the Gaussians at `indices`, in that order.
    pub fn select(&self, indices: &[u32]) -> Self {
        fn pick<T: Copy>(column: &[T], indices: &[u32]) -> Vec<T> {
            indices.iter().map(|index| column[*index as usize]).collect()
        }
        let rest = 3 * Self::sh_rest_per_channel(self.sh_degree);
        Self {
            means_in_world: pick(&self.means_in_world, indices),
            rotations_wxyz: pick(&self.rotations_wxyz, indices),
            scales: pick(&self.scales, indices),
            opacities: pick(&self.opacities, indices),
            sh_dc: pick(&self.sh_dc, indices),
            sh_rest: indices
                .iter()
                .flat_map(|at| &self.sh_rest[*at as usize * rest..][..rest])
                .copied()
                .collect(),
            sh_degree: self.sh_degree,
        }
    }

    /// Returns whether a Gaussian can be drawn: finite fields, a mean within f32, a rotation of unit length.
    ///
    /// Readers keep unusable rows so that indices stay those of the file; later stages skip and count them.
    pub fn is_usable(&self, index: usize) -> bool {
        let norm2: f32 = self.rotations_wxyz[index].iter().map(|q| q * q).sum();
        self.means_in_world[index].to_array().iter().all(|x| x.abs() <= MAX_COORDINATE)
            && (norm2 - 1.0).abs() < 1e-3
            && self.scales[index].iter().all(|s| s.is_finite() && *s >= 0.0)
            && (0.0..=1.0).contains(&self.opacities[index])
            && self.sh_dc[index].iter().all(|c| c.is_finite())
    }

    /// Leaves Gaussians without higher harmonics where these are not finite; returns how many.
    pub fn drop_broken_harmonics(&mut self) -> usize {
        let rows = self.sh_rest.chunks_exact_mut((3 * Self::sh_rest_per_channel(self.sh_degree)).max(1));
        let broken = rows.filter(|row| row.iter().any(|c| !c.is_finite()));
        broken.map(|row| row.fill(0.0)).count()
    }

    /// Undoes the decoding for files whose scales (not logarithms) or opacities (not logits) were linear already.
    pub fn deactivate(&mut self, scales: bool, opacities: bool) {
        if scales {
            self.scales.iter_mut().flatten().for_each(|scale| *scale = scale.ln().max(0.0));
        }
        if opacities {
            let logit = |opacity: f32| (opacity / (1.0 - opacity)).ln();
            self.opacities.iter_mut().for_each(|opacity| *opacity = logit(*opacity).clamp(0.0, 1.0));
        }
    }

    pub fn decoded_bytes(count: usize, sh_degree: u8) -> usize {
        count * (24 + 16 + 12 + 4 + 12 + 12 * Self::sh_rest_per_channel(sh_degree))
    }
}
