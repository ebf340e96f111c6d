//! The coordinates of a cell's embeddings: few, and such that equal distances are equal errors of scores.

use half::f16;

use slag_models::{TextEncoder, everyday_texts};

use slag_math::axes::moments_of;
use slag_math::cholesky::{SmallPivots, cholesky};
use slag_math::eigen::{EXTRA_VECTORS, leading_eigenvectors};
use slag_math::matrix::{Panels, Rows};
use slag_math::random::mix64;
use slag_math::{dot, dot_f64};

/// Share of the texts' covariance that is isotropic: it keeps directions in which no text of the bank points.
const ISOTROPIC_SHARE: f64 = 0.2;
pub(crate) const MAX_COMPONENTS: usize = 128;

/// Most texts of a bank, and fewest that show the directions of queries.
const MAX_TEXTS: usize = 2048;
const MIN_TEXTS: usize = 8;
/// One in this many texts of a large bank is held out.
const HELD_OUT_STEP: usize = 4;
/// Fewest texts of a large bank: its held-out quarter bounds 95 of 100 texts, which needs 19.
const LARGE_BANK: usize = 19 * HELD_OUT_STEP;

/// Texts like the expected queries: `[n][dim]`, unit vectors in the space of the embeddings.
#[derive(Clone, Debug, PartialEq)]
pub struct TextBank {
    pub dim: usize,
    pub vectors: Vec<f32>,
}

impl TextBank {
    /// Encodes a model's own vocabulary, or else everyday words; words that the model does not know are left out.
    /// Too few words are replaced by pseudo-random directions.
    pub(crate) fn of_model(encoder: &mut dyn TextEncoder) -> Self {
        let words: Vec<String> = match encoder.vocabulary() {
            Some(words) => words.to_vec(),
            None => everyday_texts().map(str::to_owned).collect(),
        };
        let stride = words.len().div_ceil(MAX_TEXTS).max(1);
        let dim = encoder.dim();
        let vectors = words.iter().step_by(stride).filter_map(|word| encoder.encode(word).ok());
        let bank = Self { dim, vectors: vectors.flatten().collect() };
        if bank.n_texts() < MIN_TEXTS { Self::directions(bank.dim) } else { bank }
    }

    /// Returns unit vectors in pseudo-random directions, isotropic.
    pub fn directions(dim: usize) -> Self {
        let mut vectors: Vec<f32> = (0..(256 * dim) as u64)
            .map(|i| (0..4).map(|k| (mix64(i << 2 | k) >> 40) as f32 / (1u64 << 23) as f32 - 1.0).sum())
            .collect();
        for vector in vectors.chunks_exact_mut(dim) {
            let length = dot(vector, vector).sqrt();
            vector.iter_mut().for_each(|v| *v /= length);
        }
        Self { dim, vectors }
    }

    pub fn n_texts(&self) -> usize {
        self.vectors.len() / self.dim
    }

    /// The codebook is not made for held-out texts, so errors of their scores are like those of unseen texts.
    pub fn is_held_out(&self, text: usize) -> bool {
        self.n_texts() >= LARGE_BANK && text % HELD_OUT_STEP == HELD_OUT_STEP - 1
    }
}

/// How far scores move: for a difference d of embeddings, the mean over texts of (q . d)^2 is |F' d|^2.
pub struct ScoreMetric {
    pub dim: usize,
    /// `[dim][dim]`: the lower triangle of the Cholesky factor F of the texts' second moments.
    factor: Vec<f64>,
}

impl ScoreMetric {
    /// Uses the texts that are not held out.
    pub fn new(dim: usize, bank: &TextBank) -> Self {
        let texts: Vec<usize> = (0..bank.n_texts()).filter(|text| !bank.is_held_out(*text)).collect();
        let columns = Panels::new(texts.len(), dim, |text, c| bank.vectors[texts[text] * dim + c]);
        let transposed: Vec<f32> = (0..dim)
            .flat_map(|c| texts.iter().map(move |text| (c, text)))
            .map(|(c, text)| bank.vectors[text * dim + c])
            .collect();
        let products = columns.product(Rows::all(&transposed, texts.len()));
        let scale = (1.0 - ISOTROPIC_SHARE) / texts.len() as f64;
        let mut moments: Vec<f64> = products.into_iter().map(|p| f64::from(p) * scale).collect();
        let isotropic = ISOTROPIC_SHARE / dim as f64;
        (0..dim).for_each(|i| moments[i * dim + i] += isotropic);
        // The isotropic share keeps every pivot well above the least.
        let factor = cholesky(moments, dim, SmallPivots::Raise(isotropic / 2.0));
        Self { dim, factor }
    }

    /// Standard deviation of scores over some vectors, as root mean square over texts.
    pub fn spread(&self, vectors: Rows<'_>) -> f32 {
        let (_, covariance) = moments_of(vectors);
        self.whitened(&covariance).iter().step_by(self.dim + 1).map(|v| f64::from(*v)).sum::<f64>().sqrt()
            as f32
    }

    fn whitened(&self, covariance: &[f32]) -> Vec<f32> {
        let dim = self.dim;
        let factor = Panels::new(dim, dim, |i, j| self.factor[i * dim + j] as f32);
        let right = factor.product(Rows::all(covariance, dim));
        // (F' (C F))' = (C F)' F, and the whole is symmetric.
        let transposed: Vec<f32> = (0..dim * dim).map(|at| right[at % dim * dim + at / dim]).collect();
        factor.product(Rows::all(&transposed, dim))
    }
}

/// A cell's coordinates: `embedding ~ mean + sum over c of component[c] * basis[c]`.
pub struct Basis {
    /// `[dim]`, as stored.
    pub mean: Vec<f16>,
    /// Components, m.
    pub n_components: usize,
    /// `[m][dim]`: component c of an embedding is `forms[c] . (embedding - mean)`.
    forms: Vec<f32>,
    /// `[m][dim]`.
    pub basis: Vec<f32>,
}

impl Basis {
    /// Finds the fewest components that keep the scores' root-mean-square error within a tolerance.
    pub fn fit(vectors: Rows<'_>, metric: &ScoreMetric, tolerance: f32, max_components: usize) -> Self {
        let dim = metric.dim;
        let (mean, covariance) = moments_of(vectors);
        let whitened = metric.whitened(&covariance);
        let total: f64 = whitened.iter().step_by(dim + 1).map(|v| f64::from(*v)).sum();
        let (values, directions) =
            leading_eigenvectors(&whitened, dim, (MAX_COMPONENTS + EXTRA_VECTORS).min(dim));
        let most = MAX_COMPONENTS.min(max_components).min(dim).min(vectors.len().max(2));
        let mut left = total;
        let mut n_components = 0;
        while n_components < most && (n_components < 2 || left > f64::from(tolerance).powi(2)) {
            left -= values.get(n_components).copied().unwrap_or(0.0);
            n_components += 1;
        }
        // Subspaces come in pairs, and each has a component.
        n_components = n_components.next_multiple_of(2).min(dim);
        let mut forms = vec![0.0; n_components * dim];
        let mut basis = vec![0.0; n_components * dim];
        for c in 0..n_components {
            let direction = &directions[c * dim..][..dim];
            // form = F u, basis = F'^-1 u, by back substitution.
            let mut solved = direction.to_vec();
            for i in (0..dim).rev() {
                let row = &metric.factor[i * dim..][..=i];
                solved[i] /= row[i];
                let value = solved[i];
                solved[..i].iter_mut().zip(row).for_each(|(s, f)| *s -= value * f);
            }
            for i in 0..dim {
                let row = &metric.factor[i * dim..][..=i];
                forms[c * dim + i] = dot_f64(row, &direction[..=i]) as f32;
                basis[c * dim + i] = solved[i] as f32;
            }
        }
        Self { mean, n_components, forms, basis }
    }

    /// `[n][m]`.
    pub fn components(&self, vectors: Rows<'_>) -> Vec<f32> {
        let (m, dim) = (self.n_components, self.mean.len());
        let offsets: Vec<f32> = (0..m)
            .map(|c| {
                let form = &self.forms[c * dim..][..dim];
                form.iter().zip(&self.mean).map(|(f, v)| f64::from(*f) * v.to_f64()).sum::<f64>() as f32
            })
            .collect();
        let mut out = Panels::new(dim, m, |i, c| self.forms[c * dim + i]).product(vectors);
        for components in out.chunks_exact_mut(m) {
            components.iter_mut().zip(&offsets).for_each(|(c, o)| *c -= o);
        }
        out
    }

    /// New component c is `rotation[c] . old components` (rows `[m][m]`, orthonormal).
    pub fn rotate(&mut self, rotation: &[f32]) {
        let (m, dim) = (self.n_components, self.mean.len());
        for vectors in [&mut self.forms, &mut self.basis] {
            *vectors = Panels::new(m, dim, |c, i| vectors[c * dim + i]).product(Rows::all(rotation, m));
        }
    }
}
