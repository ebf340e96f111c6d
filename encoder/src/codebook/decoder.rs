//! What readers decode.

use half::f16;
use slag_math::matrix::{Panels, Rows};

/// Decodes components to vectors, as readers do.
#[derive(Clone, Copy)]
pub(super) struct Decoder<'a> {
    pub(super) dim: usize,
    pub(super) m: usize,
    pub(super) mean: &'a [f16],
    pub(super) basis: &'a [i8],
    pub(super) steps: &'a [f32],
}

impl Decoder<'_> {
    /// Returns `[n][dim]` of components `[n][m]`.
    pub(super) fn decode(&self, components: &[f32], with_mean: bool) -> Vec<f32> {
        let mut out = self.panels().product(Rows::all(components, self.m));
        if with_mean {
            for vector in out.chunks_exact_mut(self.dim) {
                vector.iter_mut().zip(self.mean).for_each(|(v, mean)| *v += mean.to_f32());
            }
        }
        out
    }

    /// Returns the basis, to multiply components with.
    pub(super) fn panels(&self) -> Panels {
        Panels::new(self.m, self.dim, |c, i| f32::from(self.basis[c * self.dim + i]) * self.steps[c])
    }

    /// Returns the length of each basis vector.
    pub(super) fn lengths(&self) -> Vec<f32> {
        let length = |(vector, step): (&[i8], &f32)| {
            vector.iter().map(|v| f32::from(*v).powi(2)).sum::<f32>().sqrt() * step
        };
        self.basis.chunks_exact(self.dim).zip(self.steps).map(length).collect()
    }
}
