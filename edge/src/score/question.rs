//! A question as vectors.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::de::IntoDeserializer;
use serde::de::value::Error;
use serde::{Deserialize, Serialize};
use slag_common::shard::ShardView;

use super::budget::{MAX_COORDINATE, ScoreError};
use super::dot::rounding_bound;

pub use slag_math::relevancy::{RELEVANCY_STEEPNESS, relevancy, score_of_relevancy};

/// A question as vectors. A Gaussian's score is `q · E_k`, or with negatives `q · E_k - max(max_j n_j · E_k, least)`: its
/// margin over the closest negative (LERF, Kerr et al. 2023, section 3.3; [`relevancy`] maps it to 0..1).
#[derive(Clone, Debug, PartialEq)]
pub struct Question {
    /// `[dim]`, unit length.
    pub vector: Arc<[f32]>,
    /// `[dim]` each, unit length; if empty, the score is the cosine.
    pub negatives: Vec<Arc<[f32]>>,
    /// What the closest negative scores at least: what answers a question without negatives, so that they never add any.
    pub least: f32,
}

impl Question {
    pub fn new(vector: impl Into<Arc<[f32]>>) -> Self {
        Self { vector: vector.into(), negatives: Vec::new(), least: f32::NEG_INFINITY }
    }

    /// Returns all vectors, the question's own first.
    pub(super) fn vectors(&self) -> impl Iterator<Item = &[f32]> {
        std::iter::once(&*self.vector).chain(self.negatives.iter().map(|negative| &**negative))
    }

    fn check(&self) -> Result<(), ScoreError> {
        let dim = self.vector.len();
        for vector in self.vectors() {
            if vector.len() != dim {
                return Err(ScoreError::Unfit(format!(
                    "a negative has {} components, but the query vector has {dim}; encode both with the same text model",
                    vector.len()
                )));
            }
            let found = length(vector.iter().copied()) as f32;
            // Text models normalise in f32, or read f16 tables.
            if found.is_nan() || (found - 1.0).abs() > 1e-3 {
                return Err(ScoreError::Unfit(format!(
                    "the query vector has length {found}, expected 1; the text model is damaged or does not normalise its vectors"
                )));
            }
        }
        Ok(())
    }

    /// Returns the most that a score changes when an embedding moves by 1: the length of `q`, or of the longest `q - n_j`
    /// if greater, because the score is the minimum of all `(q - n_j) · E` and of `q · E - least`.
    pub(crate) fn steepness(&self) -> f32 {
        let own = length(self.vector.iter().copied());
        let apart = |n: &Arc<[f32]>| length(self.vector.iter().zip(&**n).map(|(q, n)| q - n));
        let largest = self.negatives.iter().map(apart).fold(own, f64::max);
        (largest * (1.0 + f64::from(f32::EPSILON))) as f32
    }

    pub(crate) fn rounding_bound(&self) -> f32 {
        let of_dot = rounding_bound(self.vector.len());
        // The difference of two products, each at most 1, is rounded once more.
        if self.negatives.is_empty() { of_dot } else { 2.0 * of_dot + f32::EPSILON }
    }
}

/// Checks questions and shards: dimensions, unit lengths, and the extent of positions.
pub(super) fn check(shards: &[ShardView<'_>], questions: &[Question]) -> Result<(), ScoreError> {
    for question in questions {
        question.check()?;
        for shard in shards {
            let (cell_id, expected) = (shard.header.cell_id, shard.header.dim as usize);
            let found = question.vector.len();
            if expected != found {
                return Err(ScoreError::Unfit(format!(
                    "cell {cell_id} holds embeddings of {expected} components, but the query vector has {found}; use the models that the scene was encoded with"
                )));
            }
            let reach = shard.position_box();
            let found = reach.min.abs().max(reach.max.abs()).max_element();
            if found.is_nan() || found > MAX_COORDINATE {
                return Err(ScoreError::Unfit(format!(
                    "cell {cell_id}: positions reach {found:e}, the limit is {MAX_COORDINATE:e} world units; encode the scene again around a nearer origin"
                )));
            }
        }
    }
    Ok(())
}

fn length(components: impl Iterator<Item = f32>) -> f64 {
    components.map(|v| f64::from(v).powi(2)).sum::<f64>().sqrt()
}

/// The data that scores come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Codebook centroids only: fastest; every score is within the stated bound.
    Centroids,
    /// As `Exact`, but in shards with exact embeddings reads only those that the measured errors of codes and fine
    /// residuals leave undecided. Finds nearly all of the exact answer, tens of times faster; answers state the
    /// likely errors of its scores.
    Measured,
    /// Centroids, and where they cannot decide, the shard's exact embeddings or residual codes.
    #[default]
    Exact,
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Precision {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        Self::deserialize(text.into_deserializer())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: in f64, the scores of random embeddings and of neighbours at a known distance.
    #[test]
    fn no_score_is_steeper_than_stated() {
        let mut random = slag_math::random::Random::new(3);
        let (mut steepest, dim) = (0.0f64, 6);
        for n_negatives in [0, 1, 4] {
            for _ in 0..2000 {
                let mut unit = || Arc::from(random.unit_vector(dim));
                let (vector, negatives) = (unit(), (0..n_negatives).map(|_| unit()).collect());
                let question = Question { vector, negatives, least: random.between(-1.0, 1.0) as f32 };
                let score = |e: &[f32]| {
                    let dot =
                        |v: &[f32]| v.iter().zip(e).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
                    let worst = question.negatives.iter().map(|n| dot(n)).reduce(f64::max);
                    dot(&question.vector) - worst.map_or(0.0, |worst| worst.max(question.least.into()))
                };
                let (at, step) = (random.unit_vector(dim), random.unit_vector(dim));
                let moved: Vec<f32> = at.iter().zip(&step).map(|(a, s)| a + 0.25 * s).collect();
                let distance = length(at.iter().zip(&moved).map(|(a, b)| a - b));
                let share = (score(&at) - score(&moved)).abs() / (distance * f64::from(question.steepness()));
                assert!(share <= 1.0 + 1e-6, "{share}");
                steepest = steepest.max(share);
            }
        }
        assert!(steepest > 0.9, "the bound was hardly tested: {steepest}");
    }
}
