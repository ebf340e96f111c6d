//! Eigenvectors of symmetric matrices, and orthonormal sets.

use crate::dot_f64;
use crate::matrix::{Panels, Rows};
use crate::random::mix64;

/// Rounds of subspace iteration: with [`EXTRA_VECTORS`] the last wanted eigenvalue is off by less than
/// (ratio of the eigenvalues)^(2 * 4) (Halko, Martinsson and Tropp 2011, 4.5).
const ITERATIONS: usize = 4;
/// Vectors iterated besides the wanted ones.
pub const EXTRA_VECTORS: usize = 12;

/// Returns the eigenvalues of a symmetric matrix `[n][n]`, largest first, and the eigenvectors as rows `[n][n]`
/// (cyclic Jacobi; Golub and Van Loan, Matrix Computations, 8.5). Signs are arbitrary, but the same on any
/// machine.
pub fn eigen_symmetric(mut a: Vec<f64>, n: usize) -> (Vec<f64>, Vec<f64>) {
    let mut vectors = vec![0.0; n * n];
    (0..n).for_each(|i| vectors[i * n + i] = 1.0);
    let total: f64 = a.iter().map(|v| v * v).sum();
    for _ in 0..24 {
        let off: f64 =
            (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| a[i * n + j].powi(2)).sum();
        if off <= 1e-18 * total {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                let off = a[p * n + q];
                if off * off <= 1e-20 * total / (n * n) as f64 {
                    continue;
                }
                let theta = (a[q * n + q] - a[p * n + p]) / (2.0 * off);
                let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
                let t = if theta == 0.0 { 1.0 } else { t };
                let c = 1.0 / (t * t + 1.0).sqrt();
                let s = t * c;
                for k in 0..n {
                    let (x, y) = (a[k * n + p], a[k * n + q]);
                    (a[k * n + p], a[k * n + q]) = (c * x - s * y, s * x + c * y);
                }
                rotate_rows(&mut a, n, p, q, c, s);
                rotate_rows(&mut vectors, n, p, q, c, s);
            }
        }
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|i, j| a[j * n + j].total_cmp(&a[i * n + i]).then(i.cmp(j)));
    let values = order.iter().map(|i| a[i * n + i]).collect();
    (values, order.iter().flat_map(|i| vectors[i * n..][..n].to_vec()).collect())
}

fn rotate_rows(a: &mut [f64], n: usize, p: usize, q: usize, c: f64, s: f64) {
    let (above, below) = a.split_at_mut(q * n);
    for (x, y) in above[p * n..][..n].iter_mut().zip(&mut below[..n]) {
        (*x, *y) = (c * *x - s * *y, s * *x + c * *y);
    }
}

/// Makes rows `[n][width]` orthonormal, in order (modified Gram-Schmidt, twice); dependent rows become zero.
pub fn orthonormalise(rows: &mut [f64], width: usize) {
    for i in 0..rows.len() / width {
        let (before, rest) = rows.split_at_mut(i * width);
        let row = &mut rest[..width];
        let length_before = row.iter().map(|v| v * v).sum::<f64>().sqrt();
        for _ in 0..2 {
            for other in before.chunks_exact(width) {
                let product = dot_f64(row, other);
                row.iter_mut().zip(other).for_each(|(a, b)| *a -= product * b);
            }
        }
        let length = row.iter().map(|v| v * v).sum::<f64>().sqrt();
        let scale = if length > 1e-12 * length_before { length.recip() } else { 0.0 };
        row.iter_mut().for_each(|v| *v *= scale);
    }
}

/// Returns the largest eigenvalues of a symmetric matrix `[dim][dim]` and their vectors, `[n][dim]`.
pub fn leading_eigenvectors(matrix: &[f32], dim: usize, n: usize) -> (Vec<f64>, Vec<f64>) {
    let sign = |i: u64| if mix64(i) & 1 == 0 { 1.0 } else { -1.0 };
    let mut block: Vec<f64> = (0..(n * dim) as u64).map(sign).collect();
    let panels = Panels::new(dim, dim, |i, j| matrix[i * dim + j]);
    let apply = |block: &[f64]| -> Vec<f64> {
        let block: Vec<f32> = block.iter().map(|v| *v as f32).collect();
        panels.product(Rows::all(&block, dim)).into_iter().map(f64::from).collect()
    };
    for _ in 0..ITERATIONS {
        orthonormalise(&mut block, dim);
        block = apply(&block);
    }
    orthonormalise(&mut block, dim);
    // Rayleigh-Ritz: the eigenvectors within the block's span.
    let applied = apply(&block);
    let mut small = vec![0.0; n * n];
    for i in 0..n {
        for j in 0..=i {
            let value = dot_f64(&block[i * dim..][..dim], &applied[j * dim..][..dim]);
            (small[i * n + j], small[j * n + i]) = (value, value);
        }
    }
    let (values, within) = eigen_symmetric(small, n);
    let mut vectors = vec![0.0; n * dim];
    for (vector, weights) in vectors.chunks_exact_mut(dim).zip(within.chunks_exact(n)) {
        for (weight, of_block) in weights.iter().zip(block.chunks_exact(dim)) {
            vector.iter_mut().zip(of_block).for_each(|(v, b)| *v += weight * b);
        }
    }
    (values, vectors)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn random(n: usize, seed: u64) -> Vec<f32> {
        (0..n as u64).map(|i| (mix64(seed << 32 | i) >> 40) as f32 / (1u64 << 23) as f32 - 1.0).collect()
    }

    #[test]
    fn eigenvectors_diagonalise() {
        let n = 40;
        let b = random(n * n, 5);
        let a: Vec<f64> = (0..n * n)
            .map(|at| (0..n).map(|k| f64::from(b[at / n * n + k]) * f64::from(b[at % n * n + k])).sum())
            .collect();
        let (values, vectors) = eigen_symmetric(a.clone(), n);
        assert!(values.windows(2).all(|pair| pair[0] >= pair[1]));
        for (value, vector) in values.iter().zip(vectors.chunks_exact(n)) {
            for i in 0..n {
                let product: f64 = (0..n).map(|k| a[i * n + k] * vector[k]).sum();
                assert!((product - value * vector[i]).abs() < 1e-9 * values[0]);
            }
        }
        let mut rows: Vec<f64> = random(6 * 9, 7).into_iter().map(f64::from).collect();
        rows.copy_within(0..9, 27);
        orthonormalise(&mut rows, 9);
        for i in 0..6 {
            for j in 0..6 {
                let product: f64 =
                    rows[i * 9..][..9].iter().zip(&rows[j * 9..][..9]).map(|(a, b)| a * b).sum();
                let expected = if i == j && i != 3 { 1.0 } else { 0.0 };
                assert!((product - expected).abs() < 1e-12, "{i} {j} {product}");
            }
        }
    }
}
