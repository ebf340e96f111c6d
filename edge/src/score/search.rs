//! Searches of one or several questions over a set of shards, and their results. All centroids are scored first.

use std::sync::Arc;

use rayon::prelude::*;
use slag_common::shard::ShardView;
use slag_math::simd::InstructionSet;

use super::budget::{Budget, ScoreError};
use super::project::{Projection, Vector};
use super::question::{Precision, Question, check};
use super::region::Region;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Index of the shard in the searched slice.
    pub shard: u32,
    pub index: u32,
    /// The Gaussian's own score if the shard has a code or embedding that the precision uses; else its centroid's.
    pub score: f32,
}

/// Adjacent matching Gaussians of one shard that share a score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Run {
    /// Index of the shard in the searched slice.
    pub shard: u32,
    pub start: u32,
    /// One past the last member.
    pub end: u32,
    /// Score of the centroid, or of a Gaussian scored individually.
    pub score: f32,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matches {
    /// Disjoint runs, by shard and start, ascending.
    pub runs: Vec<Run>,
    pub n_gaussians: u64,
    pub effort: Effort,
}

/// Work done beyond scoring centroids.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Effort {
    pub n_rescored: u64,
    pub n_fine_read: u64,
    pub n_embeddings_read: u64,
}

impl std::ops::AddAssign for Effort {
    fn add_assign(&mut self, other: Self) {
        self.n_rescored += other.n_rescored;
        self.n_fine_read += other.n_fine_read;
        self.n_embeddings_read += other.n_embeddings_read;
    }
}

/// One question's centroid scores over a set of shards, for several kinds of answers.
pub struct Search<'a> {
    /// All shards; runs and hits refer to them by index.
    pub shards: &'a [ShardView<'a>],
    pub(super) question: &'a Question,
    pub(super) region: Region,
    pub(super) precision: Precision,
    /// By shard; absent for those outside the region.
    pub(super) scored: Arc<[Option<ShardScores>]>,
    pub(super) budget: Budget,
    /// Indices of its vectors among those scored: its own, then its negatives.
    pub(super) places: Vec<usize>,
    /// Its index among the questions scored.
    pub(super) index: usize,
    /// See [`Question::steepness`].
    pub(super) steepness: f32,
}

pub(super) struct ShardScores {
    pub projections: Vec<Projection>,
    /// `[vectors][centroids]`.
    pub centroids: Vec<Vec<f32>>,
    /// `[questions][centroids]`: scores minus those of the negatives.
    pub combined: Vec<Vec<f32>>,
}

impl<'a> Search<'a> {
    /// [`Search::batch`] for one question, without a budget.
    pub fn new(
        shards: &'a [ShardView<'a>],
        question: &'a Question,
        region: Region,
        precision: Precision,
    ) -> Result<Self, ScoreError> {
        let questions = std::slice::from_ref(question);
        Ok(Self::batch(shards, questions, &region, precision, &Budget::default())?.swap_remove(0))
    }

    /// Scores the centroids for several questions in one pass; returns a search for each, in their order.
    ///
    /// Costs one product per centroid, component and distinct vector (shared negatives are multiplied once), in
    /// parallel by shard.
    pub fn batch(
        shards: &'a [ShardView<'a>],
        questions: &'a [Question],
        region: &Region,
        precision: Precision,
        budget: &Budget,
    ) -> Result<Vec<Self>, ScoreError> {
        check(shards, questions)?;
        let n_centroids: usize = shards.iter().map(|shard| shard.header.n_centroids as usize).sum();
        let n_vectors: usize = questions.iter().map(|question| question.vectors().count()).sum();
        budget.take(n_centroids * n_vectors * size_of::<f32>());
        budget.check()?;
        let (vectors, places) = distinct(questions);
        let score = |shard: &ShardView<'_>| {
            let is_searched = region.touches(&shard.position_box());
            is_searched.then(|| ShardScores::new(shard, questions, (&vectors, &places), precision))
        };
        let scored: Arc<[_]> = shards.par_iter().map(score).collect::<Vec<_>>().into();
        let searches = questions.iter().zip(places).enumerate().map(|(index, (question, places))| Self {
            shards,
            question,
            region: region.clone(),
            precision,
            scored: Arc::clone(&scored),
            budget: budget.clone(),
            places,
            index,
            steepness: question.steepness(),
        });
        Ok(searches.collect())
    }

    pub fn searched(&self) -> impl Iterator<Item = &'a ShardView<'a>> {
        self.shards.iter().zip(&*self.scored).filter_map(|(shard, scores)| scores.as_ref().map(|_| shard))
    }

    /// Returns the likely score error measured over a bank of texts, the largest of the shards searched; `None` if
    /// answers are exact, or a shard lacks measurements for the data read.
    pub(crate) fn likely_error(&self) -> Option<f32> {
        let mut largest = None;
        for shard in self.searched() {
            let of_codes = match self.precision {
                Precision::Centroids => shard.residuals.is_none() && shard.exact.is_none(),
                Precision::Measured => true,
                Precision::Exact => shard.exact.is_none(),
            };
            let likely = shard.header.errors.likely;
            if !of_codes || likely == 0.0 {
                return None;
            }
            largest = Some(likely.max(largest.unwrap_or(0.0)));
        }
        largest
    }

    /// Returns whether membership is exact: exact embeddings are asked for and present in every shard searched.
    pub fn is_exact(&self) -> bool {
        self.precision == Precision::Exact && self.searched().all(|shard| shard.exact.is_some())
    }
}

/// Returns the distinct vectors of some questions, and the indices of each question's vectors, its own first.
pub(super) fn distinct(questions: &[Question]) -> (Vec<Vector>, Vec<Vec<usize>>) {
    let mut distinct: Vec<&[f32]> = Vec::new();
    let mut place = |vector| {
        distinct.iter().position(|known| *known == vector).unwrap_or_else(|| {
            distinct.push(vector);
            distinct.len() - 1
        })
    };
    let places = questions.iter().map(|question| question.vectors().map(&mut place).collect()).collect();
    (distinct.into_iter().map(Vector::new).collect(), places)
}

impl ShardScores {
    fn new(
        shard: &ShardView<'_>,
        questions: &[Question],
        (vectors, places): (&[Vector], &[Vec<usize>]),
        precision: Precision,
    ) -> Self {
        let instructions = InstructionSet::widest();
        let are_codes_read = match precision {
            Precision::Centroids => false,
            Precision::Measured => true,
            Precision::Exact => shard.exact.is_none(),
        };
        let project = |vector: &Vector| {
            let mut projection = Projection::new(instructions, shard, vector);
            if are_codes_read {
                projection.prepare_codes(shard);
            }
            projection
        };
        let projections: Vec<Projection> = vectors.iter().map(project).collect();
        let centroids: Vec<Vec<f32>> =
            projections.iter().map(|of| of.score_centroids(instructions, shard)).collect();
        let combined = questions.iter().zip(places).map(|(question, places)| {
            let own = centroids[places[0]].iter().enumerate();
            let of = |(at, own): (usize, &f32)| {
                combine(*own, places[1..].iter().map(|n| centroids[*n][at]), question.least)
            };
            own.map(of).collect()
        });
        Self { combined: combined.collect(), projections, centroids }
    }
}

/// Returns a product minus the largest of its negatives' products, if any, or `least` if they are less. Never -0, which
/// would sort after 0.
pub(super) fn combine(own: f32, negatives: impl Iterator<Item = f32>, least: f32) -> f32 {
    negatives.reduce(f32::max).map_or(own, |worst| own - worst.max(least)) + 0.0
}
