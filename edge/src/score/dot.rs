//! The one inner loop: an f16 row times an f32 vector.

use half::f16;
use half::slice::HalfFloatSliceExt;

/// Independent sums: enough for two SSE, NEON or one AVX register, so the loop vectorises without
/// changing the order of additions.
const LANES: usize = 8;
/// Components converted at a time; the buffer stays in the first-level cache.
const BLOCK: usize = 512;

/// Returns `row · vector`, summed in f32 in a fixed order: the same bits on every machine and for
/// any number of threads. Components past the shorter one's end are ignored.
pub fn dot(row: &[f16], vector: &[f32]) -> f32 {
    let mut lanes = [0.0f32; LANES];
    let mut buffer = [0.0f32; BLOCK];
    for (row, vector) in row.chunks(BLOCK).zip(vector.chunks(BLOCK)) {
        let n = row.len().min(vector.len());
        let wide = &mut buffer[..n];
        row[..n].convert_to_f32_slice(wide);
        let (row_blocks, row_rest) = wide.as_chunks::<LANES>();
        let (vector_blocks, vector_rest) = vector[..n].as_chunks::<LANES>();
        for (a, b) in row_blocks.iter().zip(vector_blocks) {
            for lane in 0..LANES {
                lanes[lane] += a[lane] * b[lane];
            }
        }
        for (sum, (a, b)) in lanes.iter_mut().zip(row_rest.iter().zip(vector_rest)) {
            *sum += a * b;
        }
    }
    let [a, b, c, d, e, f, g, h] = lanes;
    ((a + e) + (c + g)) + ((b + f) + (d + h))
}

/// Returns a bound on the error of [`dot`] for unit vectors: each product passes at most
/// `dim / 8 + 5` roundings of 2^-24, and the absolute products sum to at most 1; doubled, since a
/// stored row may be a little longer than 1.
pub fn rounding_bound(dim: usize) -> f32 {
    (dim.div_ceil(LANES) + 5) as f32 * f32::EPSILON
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// Oracle: a plain f64 sum.
        #[test]
        fn equals_a_float64_sum(pairs in prop::collection::vec((-1.0f32..1.0, -1.0f32..1.0), 0..1300)) {
            let row: Vec<f16> = pairs.iter().map(|(a, _)| f16::from_f32(*a)).collect();
            let vector: Vec<f32> = pairs.iter().map(|(_, b)| *b).collect();
            let terms = || row.iter().zip(&vector).map(|(a, b)| a.to_f64() * f64::from(*b));
            let expected: f64 = terms().sum();
            let absolute: f64 = terms().map(f64::abs).sum();
            let bound = f64::from(rounding_bound(pairs.len())) * absolute + 1e-30;
            prop_assert!((f64::from(dot(&row, &vector)) - expected).abs() <= bound);
        }
    }
}
