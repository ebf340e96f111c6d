//! A question's vector in a cell's terms: rounded to 16 bits, projected on the cell's basis, tabulated for codes.
//!
//! With `q^` the question's vector `q` rounded to 16 bits and `y[c] = basis_steps[c] * basis[c] . q^`, a
//! centroid scores `mean . q + centroid_step * centroids[r] . y^`, where `y^` is `y` rounded to 16 bits;
//! without a basis `y^` is `q^`. Both are integer products. The score differs from `q . P[r]` by at most `|q
//! - q^| |P[r] - mean| + centroid_step |y - y^| |centroids[r]|` (Cauchy-Schwarz).
//!
//! A residual code adds `residual_scale * (offset + step * sum over subspaces of table[s][code])`, where
//! `offset + step * table` is `codewords . y` rounded to 8 bits. It differs from the product of the decoded
//! residual by at most `|q - q^| |residual| + residual_scale * sum over subspaces of the largest rounding
//! error in each`.

use slag_common::shard::{BLOCK, CODEWORDS, Residuals, ShardView};
use slag_math::simd::InstructionSet;

use super::dot::widen;
use super::simd::{Column, PAD, RowsTimesVector};

/// Largest sum of absolute steps: times the 128 of a centroid's largest component it still fits in 32 bits.
const MOST_IN_SUM: u64 = (1 << 24) - 1;

/// A vector quantised to 16 bits.
#[derive(Clone, Debug, Default)]
pub struct Rounded {
    /// Value of one step: a power of two, so that scaling is exact.
    pub step: f64,
    /// Steps, padded with zeros to a multiple of [`PAD`].
    pub steps: Vec<i16>,
    pub error: f64,
}

impl Rounded {
    /// Rounds finite values with the smallest step that keeps all products with 8-bit centroids within 32 bits.
    pub fn new(values: &[f64]) -> Self {
        let largest = values.iter().fold(0.0f64, |most, v| most.max(v.abs()));
        let sum: f64 = values.iter().map(|v| v.abs()).sum();
        // Rounding adds at most half a step to each.
        let capacity = MOST_IN_SUM as f64 - 0.5 * values.len() as f64;
        let least = (largest / f64::from(i16::MAX)).max(sum / capacity).max(f64::MIN_POSITIVE);
        let step = power_of_two_from(least);
        let mut squares = 0.0;
        let round = |value: &f64| {
            let steps = nearest(value / step);
            squares += (value - f64::from(steps) * step).powi(2);
            steps as i16
        };
        let mut steps: Vec<i16> = values.iter().map(round).collect();
        steps.resize(values.len().next_multiple_of(PAD), 0);
        Self { step, steps, error: squares.sqrt() }
    }
}

/// A vector of a question, rounded once for all cells.
#[derive(Clone, Debug)]
pub struct Vector {
    /// `[dim]`.
    pub exact: Vec<f64>,
    pub rounded: Rounded,
    pub length: f64,
}

impl Vector {
    pub fn new(values: &[f32]) -> Self {
        let exact: Vec<f64> = values.iter().map(|v| f64::from(*v)).collect();
        let length = exact.iter().map(|v| v * v).sum::<f64>().sqrt();
        Self { rounded: Rounded::new(&exact), length, exact }
    }
}

#[derive(Clone, Debug, Default)]
pub struct Tables {
    /// `[S / 2]`: values of the even subspaces' codewords, twice over.
    pub low: Vec<Column>,
    /// `[S / 2]`: the same for the odd subspaces.
    pub high: Vec<Column>,
    pub step: f32,
    /// Sum of the subspaces' smallest values.
    pub offset: f32,
    /// Largest sum that a code can give.
    pub most: u16,
    /// Sum of the subspaces' largest rounding errors.
    pub error: f32,
}

#[derive(Clone, Debug, Default)]
pub struct Projection {
    /// Product with the cell's mean.
    pub base: f64,
    /// `[m]`: products with the basis vectors, or the vector's own components.
    pub components: Vec<f64>,
    pub rounded: Rounded,
    /// Rounding error of a centroid's score for each unit of the centroid's distance from the mean.
    pub error_per_length: f32,
    /// Rounding error of a centroid's score that does not depend on that distance.
    pub error: f32,
    pub mean_length: f32,
    pub tables: Tables,
    /// Multiplier of fine residuals, in cells that have them.
    pub fine: Rounded,
}

impl Projection {
    pub fn new(instructions: InstructionSet, shard: &ShardView<'_>, vector: &Vector) -> Self {
        let error_per_length = up(vector.rounded.error);
        let Some(basis) = &shard.basis else {
            let (components, rounded) = (vector.exact.clone(), vector.rounded.clone());
            return Self { components, rounded, error_per_length, ..Self::default() };
        };
        let m = shard.header.n_components as usize;
        let products = instructions.dispatch(RowsTimesVector {
            rows: basis.vectors,
            n_components: vector.exact.len(),
            vector: &vector.rounded.steps,
            which: &(0..m as u32).collect::<Vec<_>>(),
        });
        let scaled = |(step, dot): (&f32, i32)| f64::from(*step) * (vector.rounded.step * f64::from(dot));
        let components: Vec<f64> = basis.steps.iter().zip(products).map(scaled).collect();
        let mean = || basis.mean.iter().map(|v| f64::from(widen(*v)));
        let (rounded, step) = (Rounded::new(&components), f64::from(shard.header.centroid_step));
        Self {
            base: mean().zip(&vector.exact).map(|(a, b)| a * b).sum(),
            mean_length: up(mean().map(|v| v * v).sum::<f64>().sqrt()),
            error: up(rounded.error * step * 128.0 * (m as f64).sqrt()),
            components,
            rounded,
            error_per_length,
            ..Self::default()
        }
    }

    /// Scores a cell's centroids. Returns `[K]`.
    pub(crate) fn score_centroids(&self, instructions: InstructionSet, shard: &ShardView<'_>) -> Vec<f32> {
        let step = f64::from(shard.header.centroid_step) * self.rounded.step;
        let products = instructions.dispatch(RowsTimesVector {
            rows: shard.centroids,
            n_components: shard.header.n_components as usize,
            vector: &self.rounded.steps,
            which: &(0..shard.header.n_centroids).collect::<Vec<_>>(),
        });
        // Never -0, which would sort after 0 though it is equal.
        products.into_iter().map(|dot| (self.base + step * f64::from(dot)) as f32 + 0.0).collect()
    }

    /// Prepares the multipliers of the shard's residual codes and fine residuals.
    pub(crate) fn prepare_codes(&mut self, shard: &ShardView<'_>) {
        if let Some(residuals) = &shard.residuals {
            self.tables = Tables::new(residuals, &self.components);
        }
        if let Some(fine) = shard.exact.and_then(|exact| exact.fine) {
            let scaled = self.components.iter().zip(fine.steps).map(|(y, step)| y * f64::from(*step));
            self.fine = Rounded::new(&scaled.collect::<Vec<f64>>());
        }
    }
}

impl Tables {
    fn new(residuals: &Residuals<'_>, components: &[f64]) -> Self {
        let mut values = vec![[0.0f64; CODEWORDS]; residuals.subspace_starts.len() - 1];
        let (mut offset, mut widest) = (0.0, 0.0f64);
        for (values, starts) in values.iter_mut().zip(residuals.subspace_starts.windows(2)) {
            let (start, end) = (starts[0] as usize, starts[1] as usize);
            let codewords = residuals.codewords[CODEWORDS * start..CODEWORDS * end].chunks_exact(end - start);
            for (value, codeword) in values.iter_mut().zip(codewords) {
                let terms = codeword.iter().zip(&components[start..end]);
                *value = terms.map(|(w, y)| f64::from(widen(*w)) * y).sum();
            }
            let least = values.iter().copied().fold(f64::INFINITY, f64::min);
            values.iter_mut().for_each(|value| *value -= least);
            offset += least;
            widest = values.iter().copied().fold(widest, f64::max);
        }
        let mut tables = Self { step: (widest / 255.0) as f32, offset: offset as f32, ..Self::default() };
        let (step, mut error) = (f64::from(tables.step), 0.0);
        for (subspace, values) in values.iter().enumerate() {
            let mut column = [0; BLOCK];
            let (mut most, mut largest_rounding) = (0, 0.0f64);
            for (codeword, value) in values.iter().enumerate() {
                let steps = if step > 0.0 { nearest(value / step).min(255) } else { 0 };
                largest_rounding = largest_rounding.max((value - f64::from(steps) * step).abs());
                column[codeword] = steps as u8;
                column[codeword + CODEWORDS] = column[codeword];
                most = most.max(column[codeword]);
            }
            tables.most += u16::from(most);
            error += largest_rounding;
            let half = if subspace.is_multiple_of(2) { &mut tables.low } else { &mut tables.high };
            half.push(column);
        }
        tables.error = up(error + (offset - f64::from(tables.offset)).abs());
        tables
    }
}

fn power_of_two_from(value: f64) -> f64 {
    const MANTISSA: u64 = (1 << 52) - 1;
    f64::from_bits((value.to_bits() + MANTISSA) & !MANTISSA)
}

/// Rounds to nearest. (Without SSE 4.1 the standard rounding is a function call.)
fn nearest(value: f64) -> i32 {
    (value + 0.5f64.copysign(value)) as i32
}

pub fn up(bound: f64) -> f32 {
    (bound * (1.0 + f64::from(f32::EPSILON))) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_math::random::Random;

    /// Oracle: the definition, in wide integers and float64.
    #[test]
    fn rounded_vectors_fit_and_are_as_near_as_stated() {
        let mut random = Random::new(13);
        for n in (1..40usize).chain([512, 8191, 8192]) {
            for (scale, is_flat) in [(1.0, false), (1.0, true), (1e-30, false), (1e6, true), (0.0, false)] {
                let mut value = |_| if is_flat { scale } else { f64::from(random.signed()) * scale };
                let values: Vec<f64> = (0..n).map(&mut value).collect();
                let rounded = Rounded::new(&values);
                assert_eq!(rounded.steps.len(), n.next_multiple_of(PAD));
                let sum: i64 = rounded.steps.iter().map(|v| i64::from(*v).abs()).sum();
                assert!(sum * 128 < 1 << 31, "{n} {scale} {sum}");
                assert_eq!(rounded.step.to_bits() & ((1 << 52) - 1), 0, "a power of two: {}", rounded.step);
                let off = values.iter().zip(&rounded.steps).map(|(v, s)| v - f64::from(*s) * rounded.step);
                let squares: f64 = off.clone().map(|v| v * v).sum();
                assert!((squares.sqrt() - rounded.error).abs() <= 1e-9 * rounded.error);
                assert!(off.clone().all(|off| off.abs() <= rounded.step * 0.5));
                // No step is more than twice as large as necessary.
                let largest = rounded.steps.iter().map(|s| s.unsigned_abs()).max();
                assert!(scale == 0.0 || largest >= Some(1 << 14) || sum * 128 > 1 << 29, "{n} {scale} {sum}");
            }
        }
    }
}
