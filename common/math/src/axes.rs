//! Mean, covariance and principal axes of many vectors.

use half::f16;

use crate::eigen::{EXTRA_VECTORS, leading_eigenvectors};
use crate::matrix::{Panels, Rows};

/// Vectors in the even sample for a covariance.
const COVARIANCE_SAMPLE: usize = 4096;

/// Returns the coordinates `[vectors][n]` of vectors along their `n` principal axes through the origin; zeros
/// beyond the rank. Scalar products are preserved, except for parts outside these axes.
pub fn principal_coordinates(vectors: Rows<'_>, n: usize) -> Vec<f32> {
    let dim = vectors.width;
    let (mean, mut moments) = moments_of(vectors);
    for (i, row) in moments.chunks_exact_mut(dim).enumerate() {
        row.iter_mut().zip(&mean).for_each(|(m, v)| *m += (mean[i].to_f64() * v.to_f64()) as f32);
    }
    let (_, axes) = leading_eigenvectors(&moments, dim, (n + EXTRA_VECTORS).min(dim));
    Panels::new(dim, n, |i, c| if c < dim { axes[c * dim + i] as f32 } else { 0.0 }).product(vectors)
}

/// Returns mean (rounded as stored) and covariance `[dim][dim]` of an even sample of vectors.
pub fn moments_of(vectors: Rows<'_>) -> (Vec<f16>, Vec<f32>) {
    let (n, dim) = (vectors.len(), vectors.width);
    let stride = n.div_ceil(COVARIANCE_SAMPLE).max(1);
    let sample: Vec<usize> = (0..n).step_by(stride).collect();
    let mut mean = vec![0.0f64; dim];
    for row in &sample {
        mean.iter_mut().zip(vectors.get(*row)).for_each(|(m, v)| *m += f64::from(*v));
    }
    let count = sample.len().max(1) as f64;
    let mean: Vec<f16> = mean.iter().map(|m| f16::from_f64(m / count)).collect();
    let means: Vec<f32> = mean.iter().map(|v| v.to_f32()).collect();
    let mut transposed = vec![0.0; dim * sample.len()];
    for (column, row) in sample.iter().enumerate() {
        for (c, value) in vectors.get(*row).iter().enumerate() {
            transposed[c * sample.len() + column] = value - means[c];
        }
    }
    if sample.is_empty() {
        return (mean, vec![0.0; dim * dim]);
    }
    let columns = Panels::new(sample.len(), dim, |row, c| transposed[c * sample.len() + row]);
    let mut covariance = columns.product(Rows::all(&transposed, sample.len()));
    covariance.iter_mut().for_each(|v| *v = (f64::from(*v) / count) as f32);
    (mean, covariance)
}
