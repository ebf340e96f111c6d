//! The errors of decoded scores, measured over a bank of texts.

use rayon::prelude::*;
use slag_common::shard::ScoreErrors;

use super::basis::TextBank;
use slag_math::matrix::{Panels, Rows};
use slag_math::stats::{Rank, quantile};

/// Most sampled Gaussians of a cell.
const SAMPLE: usize = 1024;

/// The true scores of some Gaussians.
pub struct Sample<'a> {
    bank: &'a TextBank,
    texts: Panels,
    stride: usize,
    /// Standard deviation over the sample of a text's scores, mean over the texts.
    spread: f32,
    /// Of all scores.
    pub moments: ScoreMoments,
}

/// Sums over pairs of a text and a Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ScoreMoments {
    /// Mean of the scores.
    pub mean: f64,
    /// Mean of their squares.
    pub mean_square: f64,
}

impl ScoreMoments {
    fn of(scores: &[f32]) -> Self {
        let n = scores.len().max(1) as f64;
        let mean = |power: i32| scores.iter().map(|s| f64::from(*s).powi(power)).sum::<f64>() / n;
        Self { mean: mean(1), mean_square: mean(2) }
    }
}

impl<'a> Sample<'a> {
    /// Takes every n-th embedding, in the given order.
    pub fn new(embeddings: Rows<'_>, order: &[u32], bank: &'a TextBank) -> Self {
        let dim = embeddings.width;
        let stride = order.len().div_ceil(SAMPLE).max(1);
        let texts = Panels::new(dim, bank.len(), |c, text| bank.vectors[text * dim + c]);
        let chosen: Vec<f32> =
            order.iter().step_by(stride).flat_map(|at| embeddings.get(*at as usize)).copied().collect();
        let scores = match bank.is_empty() {
            true => Vec::new(),
            false => texts.product(Rows::all(&chosen, dim)),
        };
        let (spread, moments) = (spread(&scores, bank.len()), ScoreMoments::of(&scores));
        Self { bank, texts, stride, spread, moments }
    }

    /// Whether the Gaussian at a place of the order belongs to the sample.
    pub fn has(&self, place: usize) -> bool {
        place.is_multiple_of(self.stride)
    }

    /// Returns the errors of scores; zeros without texts. `missed`: the sample's embeddings minus their decoded form,
    /// `[sample][dim]`.
    pub fn errors(&self, missed: &[f32]) -> ScoreErrors {
        if self.bank.is_empty() || missed.is_empty() {
            return ScoreErrors { spread: self.spread, ..ScoreErrors::default() };
        }
        let mut errors = self.texts.product(Rows::all(missed, self.bank.dim));
        errors.par_iter_mut().for_each(|e| *e = e.abs());
        let n = errors.len();
        // Gaussian by Gaussian: the sum is the same for any number of threads.
        let mean = errors
            .chunks(self.bank.len())
            .map(|of_gaussian| of_gaussian.iter().map(|e| f64::from(*e)).sum::<f64>())
            .sum::<f64>()
            / n as f64;
        let max = errors.iter().copied().fold(0.0, f32::max);
        let p999 = quantile(&mut errors, 999, Rank::After).unwrap_or_default();
        ScoreErrors { mean: mean as f32, p999, max, spread: self.spread }
    }
}

/// Returns the standard deviation of each column of `[n][n_columns]`, averaged over the columns.
pub fn spread(scores: &[f32], n_columns: usize) -> f32 {
    if n_columns == 0 || scores.is_empty() {
        return 0.0;
    }
    let n = (scores.len() / n_columns) as f64;
    let (mut sums, mut squares) = (vec![0.0f64; n_columns], vec![0.0f64; n_columns]);
    for row in scores.chunks_exact(n_columns) {
        for ((sum, square), score) in sums.iter_mut().zip(&mut squares).zip(row) {
            *sum += f64::from(*score);
            *square += f64::from(*score).powi(2);
        }
    }
    let deviations =
        sums.iter().zip(&squares).map(|(sum, square)| (square / n - (sum / n).powi(2)).max(0.0).sqrt());
    (deviations.sum::<f64>() / n_columns as f64) as f32
}
