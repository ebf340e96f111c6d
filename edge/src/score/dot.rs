//! The loop over exact embeddings: an f16 vector times an f32 vector.

use half::f16;
use slag_math::simd::Work;

use super::simd::Kernels;

/// Independent partial sums: one AVX register, two of SSE or NEON.
const LANES: usize = 8;
/// Components multiplied at a time; their products stay in the L1 cache.
const BLOCK: usize = 512;

/// Converts a finite f16 to f32, exactly, with operations of every vector unit: shifts the bits into place and
/// corrects the exponent bias by 127 - 15 = 112. (Conversion instructions would need a runtime check every few
/// components.)
#[inline(always)]
pub(super) fn widen(value: f16) -> f32 {
    const BIAS: f32 = f32::from_bits((127 + 112) << 23);
    let bits = u32::from(value.to_bits());
    f32::from_bits((bits & 0x8000) << 16 | (bits & 0x7fff) << 13) * BIAS
}

/// Returns `embedding · vector`, summed in f32 in a fixed order: the same bits on every machine and for any number of
/// threads. Ignores components beyond the shorter vector. The embedding must be finite, as in checked shards.
#[inline(always)]
pub fn dot(embedding: &[f16], vector: &[f32]) -> f32 {
    let mut lanes = [0.0f32; LANES];
    let mut products = [0.0f32; BLOCK];
    for (embedding, vector) in embedding.chunks(BLOCK).zip(vector.chunks(BLOCK)) {
        let n = embedding.len().min(vector.len());
        // Plain loops for products and halvings: the compiler vectorises these, but not one over eight running sums.
        for ((product, a), b) in products.iter_mut().zip(embedding).zip(vector) {
            *product = widen(*a) * b;
        }
        let mut width = n.next_power_of_two().max(LANES);
        products[n..width].fill(0.0);
        while width > LANES {
            width /= 2;
            let (low, high) = products.split_at_mut(width);
            for (a, b) in low.iter_mut().zip(&*high) {
                *a += b;
            }
        }
        for (lane, product) in lanes.iter_mut().zip(&products) {
            *lane += product;
        }
    }
    let [a, b, c, d, e, f, g, h] = lanes;
    ((a + e) + (c + g)) + ((b + f) + (d + h))
}

/// [`dot`] compiled for an instruction set: wider vectors, the same sums.
pub(super) struct EmbeddingTimesVector<'a>(pub &'a [f16], pub &'a [f32]);

impl<K: Kernels> Work<K> for EmbeddingTimesVector<'_> {
    type Output = f32;

    #[inline(always)]
    fn run(self, _: K) -> f32 {
        dot(self.0, self.1)
    }
}

/// Bounds the error of [`dot`] for unit vectors: each product passes at most 1 + 6 roundings in its block, one per
/// block and 3 at the end, of 2^-24 each, and the absolute products sum to at most 1. Doubled, because a stored
/// embedding may be slightly longer than 1.
pub fn rounding_bound(dim: usize) -> f32 {
    (dim.div_ceil(BLOCK) + 10) as f32 * f32::EPSILON
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use slag_math::simd::InstructionSet;

    use super::*;

    /// Oracle: the half crate's conversion, over every finite f16.
    #[test]
    fn widening_is_exact() {
        for value in (0..=u16::MAX).map(f16::from_bits).filter(|value| value.is_finite()) {
            assert_eq!(widen(value).to_bits(), value.to_f32().to_bits(), "{value}");
        }
    }

    proptest! {
        /// Oracle: a plain f64 sum.
        #[test]
        fn equals_a_float64_sum(pairs in prop::collection::vec((-1.0f32..1.0, -1.0f32..1.0), 0..1300)) {
            let embedding: Vec<f16> = pairs.iter().map(|(a, _)| f16::from_f32(*a)).collect();
            let vector: Vec<f32> = pairs.iter().map(|(_, b)| *b).collect();
            let terms = || embedding.iter().zip(&vector).map(|(a, b)| a.to_f64() * f64::from(*b));
            let expected: f64 = terms().sum();
            let absolute: f64 = terms().map(f64::abs).sum();
            let bound = f64::from(rounding_bound(pairs.len())) * absolute + 1e-30;
            prop_assert!((f64::from(dot(&embedding, &vector)) - expected).abs() <= bound);
            for set in InstructionSet::available() {
                let found = set.dispatch(EmbeddingTimesVector(&embedding, &vector));
                prop_assert_eq!(found.to_bits(), dot(&embedding, &vector).to_bits(), "{}", set.name());
            }
        }
    }
}
