//! The errors of decoded scores, measured over a bank of texts.

use half::f16;
use rayon::prelude::*;
use slag_common::shard::ScoreErrors;
use slag_math::matrix::{Panels, Rows};

use super::basis::TextBank;
use super::cluster::Members;

/// Share of texts that the likely error covers, in 1,000.
const LIKELY_TEXTS: usize = 950;
/// Share of such a text's scores within the bound, in 1,000.
const LIKELY_SCORES: usize = 990;

const SAMPLE: usize = 1024;

/// The true scores of some Gaussians.
pub(crate) struct Sample<'a> {
    bank: &'a TextBank,
    texts: Panels,
    stride: usize,
    /// Standard deviation of a text's scores over the sample, mean over the texts.
    spread: f32,
    pub moments: ScoreMoments,
}

/// Sums over pairs of a text and a Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ScoreMoments {
    pub mean: f64,
    pub(crate) mean_square: f64,
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
        let texts = Panels::new(dim, bank.n_texts(), |c, text| bank.vectors[text * dim + c]);
        let chosen: Vec<f32> =
            order.iter().step_by(stride).flat_map(|at| embeddings.get(*at as usize)).copied().collect();
        let scores = texts.product(Rows::all(&chosen, dim));
        let (spread, moments) = (spread(&scores, bank.n_texts()), ScoreMoments::of(&scores));
        Self { bank, texts, stride, spread, moments }
    }

    /// `place`: in the order.
    pub fn has(&self, place: usize) -> bool {
        place.is_multiple_of(self.stride)
    }

    /// Errors of scores; zeros without embeddings. `missed`: `[sample][dim]`, embeddings minus their decoded form.
    pub fn errors(&self, missed: &[f32]) -> ScoreErrors {
        if missed.is_empty() {
            return ScoreErrors { spread: self.spread, ..ScoreErrors::default() };
        }
        let mut errors = self.texts.product(Rows::all(missed, self.bank.dim));
        errors.par_iter_mut().for_each(|e| *e = e.abs());
        let n = errors.len();
        // By Gaussian, so that the sum does not depend on threads.
        let mean = errors
            .chunks(self.bank.n_texts())
            .map(|of_gaussian| of_gaussian.iter().map(|e| f64::from(*e)).sum::<f64>())
            .sum::<f64>()
            / n as f64;
        let max = errors.iter().copied().fold(0.0, f32::max);
        let likely = likely_error(&errors, self.bank.n_texts(), |text| self.bank.is_held_out(text));
        ScoreErrors { mean: mean as f32, likely: likely.unwrap_or_default(), max, spread: self.spread }
    }
}

/// Bounds scores of a text like those held out, by split conformal prediction (Vovk, Gammerman and Shafer 2005): for 95
/// of 100 such texts, 99 of 100 scores err by no more. It is the ceil(0.95 (h + 1))-th smallest of the h held-out
/// texts' own 99th percentiles; `None` if that is more than h. `errors`: `[n][n_texts]`, absolute.
pub(crate) fn likely_error(
    errors: &[f32],
    n_texts: usize,
    is_held_out: impl Fn(usize) -> bool,
) -> Option<f32> {
    if errors.is_empty() {
        return None;
    }
    let percentile = |text: usize| {
        let mut of_text: Vec<f32> = errors.iter().skip(text).step_by(n_texts).copied().collect();
        let rank = (of_text.len() * LIKELY_SCORES).div_ceil(1000).max(1) - 1;
        *of_text.select_nth_unstable_by(rank, f32::total_cmp).1
    };
    let mut of_texts: Vec<f32> = (0..n_texts).filter(|text| is_held_out(*text)).map(percentile).collect();
    let rank = ((of_texts.len() + 1) * LIKELY_TEXTS).div_ceil(1000);
    (rank <= of_texts.len()).then(|| *of_texts.select_nth_unstable_by(rank - 1, f32::total_cmp).1)
}

/// Standard deviation of each column of `[n][n_columns]`, averaged over the columns.
pub fn spread(scores: &[f32], n_columns: usize) -> f32 {
    if scores.is_empty() {
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

const CHUNK: usize = 1024;

#[derive(Clone, Copy)]
pub(super) struct Decoder<'a> {
    pub(super) dim: usize,
    pub(super) m: usize,
    pub(super) mean: &'a [f16],
    pub(super) basis: &'a [i8],
    pub(super) steps: &'a [f32],
}

impl Decoder<'_> {
    /// `[n][m]` to `[n][dim]`.
    pub(super) fn decode(&self, components: &[f32]) -> Vec<f32> {
        let mut out = self.panels().product(Rows::all(components, self.m));
        for vector in out.chunks_exact_mut(self.dim) {
            vector.iter_mut().zip(self.mean).for_each(|(v, mean)| *v += mean.to_f32());
        }
        out
    }

    pub(super) fn panels(&self) -> Panels {
        Panels::new(self.m, self.dim, |c, i| f32::from(self.basis[c * self.dim + i]) * self.steps[c])
    }

    pub(super) fn lengths(&self) -> Vec<f32> {
        let length = |(vector, step): (&[i8], &f32)| {
            vector.iter().map(|v| f32::from(*v).powi(2)).sum::<f32>().sqrt() * step
        };
        self.basis.chunks_exact(self.dim).zip(self.steps).map(length).collect()
    }
}

pub(super) struct Reference<'a> {
    pub(super) embeddings: Rows<'a>,
    pub(super) members: &'a Members,
    /// `[K][dim]`.
    pub(super) decoded_centroids: &'a [f32],
    pub(super) sample: &'a Sample<'a>,
}

impl Reference<'_> {
    /// Returns each centroid's largest distance of a member from its decoded form, and the errors of decoded scores.
    /// `residuals`: components to add to the centroids, in the order of the members.
    pub(super) fn compare(&self, residuals: Option<(&Decoder<'_>, &[f32])>) -> (Vec<f32>, ScoreErrors) {
        let Self { embeddings, members, decoded_centroids, sample } = self;
        let (order, centroid_starts) = (&members.order, &members.starts);
        let dim = embeddings.width;
        let added = residuals
            .map(|(decoder, components)| (decoder.panels(), decoder.lengths(), decoder.m, components));
        let chunks: Vec<(Vec<f32>, Vec<f32>)> = (0..order.len().div_ceil(CHUNK))
            .into_par_iter()
            .map(|chunk| {
                let places = chunk * CHUNK..order.len().min((chunk + 1) * CHUNK);
                let mut decoded = match &added {
                    Some((panels, _, m, components)) => {
                        panels.product(Rows::all(&components[places.start * m..places.end * m], *m))
                    }
                    None => vec![0.0; places.len() * dim],
                };
                let mut centroid =
                    centroid_starts.partition_point(|start| *start as usize <= places.start) - 1;
                let mut distances = Vec::with_capacity(places.len());
                let mut missed = Vec::new();
                for (place, decoded) in places.zip(decoded.chunks_exact_mut(dim)) {
                    while centroid_starts[centroid + 1] as usize <= place {
                        centroid += 1;
                    }
                    let embedding = embeddings.get(order[place] as usize);
                    let of_centroid = &decoded_centroids[centroid * dim..][..dim];
                    for ((d, r), e) in decoded.iter_mut().zip(of_centroid).zip(embedding) {
                        *d = e - (r + *d);
                    }
                    // Bound of rounding: sizes of the products' terms times the number of additions.
                    let rounding = added.as_ref().map_or(0.0, |(_, lengths, m, components)| {
                        let terms =
                            components[place * m..][..*m].iter().zip(lengths).map(|(c, l)| c.abs() * l);
                        terms.sum::<f32>() * (*m as f32 + 4.0) * f32::EPSILON
                    });
                    let slack = 1.0 + dim as f32 * f32::EPSILON;
                    let length = slag_math::dot(decoded, decoded).sqrt();
                    distances.push((length * slack + rounding + 2.0 * f32::EPSILON).next_up());
                    if sample.has(place) {
                        missed.extend_from_slice(decoded);
                    }
                }
                (distances, missed)
            })
            .collect();
        let distances: Vec<f32> = chunks.iter().flat_map(|(distances, _)| distances).copied().collect();
        let missed: Vec<f32> = chunks.into_iter().flat_map(|(_, missed)| missed).collect();
        let radius = |members: &[u32]| {
            distances[members[0] as usize..members[1] as usize].iter().copied().fold(0.0, f32::max)
        };
        (centroid_starts.windows(2).map(radius).collect(), sample.errors(&missed))
    }
}

#[cfg(test)]
mod tests {
    use slag_math::random::Random;

    use super::*;

    /// By hand: 19 texts, 3 Gaussians; the largest of the texts' largest errors. One text fewer gives no bound.
    #[test]
    fn the_likely_error_is_that_of_the_ranks() {
        let errors: Vec<f32> = (0..3).flat_map(|k| (0..19).map(move |text| (text * 3 + k) as f32)).collect();
        assert_eq!(likely_error(&errors, 19, |_| true), Some(56.0));
        assert_eq!(likely_error(&errors, 19, |text| text > 0), None);
        assert_eq!(likely_error(&[], 19, |_| true), None);
    }

    /// The promise itself: errors of texts that were not used for the bound, each text with a scale of its own.
    #[test]
    fn new_texts_are_within_the_likely_error_as_often_as_stated() {
        let mut random = Random::new(11);
        let (n, n_texts, n_trials) = (200, 120, 300);
        let mut of_text = || -> Vec<f32> {
            let scale = (2.0 * random.normal()).exp() as f32;
            (0..n).map(|_| scale * random.normal().abs() as f32).collect()
        };
        let mut n_within = 0;
        for _ in 0..n_trials {
            let texts: Vec<Vec<f32>> = (0..n_texts).map(|_| of_text()).collect();
            let errors: Vec<f32> = (0..n).flat_map(|k| texts.iter().map(move |text| text[k])).collect();
            let bound = likely_error(&errors, n_texts, |text| text % 4 == 3).expect("30 texts are held out");
            let new = of_text();
            n_within += usize::from(new.iter().filter(|e| **e <= bound).count() * 100 >= 99 * n);
        }
        // 95 % or a little more; three standard deviations of 300 trials are 3.8 %.
        let share = f64::from(n_within as u32) / f64::from(n_trials);
        assert!((0.912..=0.999).contains(&share), "{share}");
    }
}
