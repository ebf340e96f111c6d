//! Scores of all centroids: the first step of every answer.

use std::sync::Arc;

use rayon::prelude::*;
use slag_common::shard::ShardView;
use slag_math::simd::InstructionSet;

use super::budget::Budget;
use super::project::{Projection, Vector};
use super::question::{Precision, Question};
use super::region::Region;

#[derive(Default)]
pub(super) struct CentroidScores {
    /// The distinct vectors of all questions.
    pub vectors: Vec<Vector>,
    /// By index in the slice of shards.
    pub shards: Vec<ShardScores>,
}

pub(super) struct AskedQuestion<'a> {
    pub shards: &'a [ShardView<'a>],
    pub question: &'a Question,
    pub region: Region,
    pub precision: Precision,
    pub scored: Arc<CentroidScores>,
    pub budget: Budget,
    /// Indices of its vectors among those scored: its own, then its negatives.
    pub places: Vec<usize>,
    /// Its index among the questions scored.
    pub index: usize,
    /// See [`Question::steepness`].
    pub steepness: f32,
}

#[derive(Default)]
pub(super) struct ShardScores {
    /// Whether the shard reaches into the region; otherwise the other fields are stale.
    pub is_searched: bool,
    pub projections: Vec<Projection>,
    /// `[vectors][centroids]`.
    pub centroids: Vec<Vec<f32>>,
    /// `[questions][centroids]`: scores minus those of the negatives; empty for questions without negatives.
    pub combined: Vec<Vec<f32>>,
}

impl CentroidScores {
    /// Scores the centroids of shards in the region. Returns the indices of each question's vectors, its own first.
    pub fn score(
        &mut self,
        shards: &[ShardView<'_>],
        questions: &[Question],
        region: Region,
        precision: Precision,
    ) -> Vec<Vec<usize>> {
        let (distinct, places) = distinct(questions);
        self.vectors.resize_with(distinct.len(), Vector::default);
        self.vectors.iter_mut().zip(distinct).for_each(|(vector, values)| vector.set(values));
        self.shards.resize_with(shards.len(), ShardScores::default);
        let (instructions, vectors) = (InstructionSet::widest(), &self.vectors);
        self.shards.par_iter_mut().zip(shards).for_each(|(scores, shard)| {
            scores.is_searched = region.touches(&shard.position_box());
            if scores.is_searched {
                scores.score(instructions, shard, vectors, &places, precision);
            }
        });
        places
    }
}

/// Returns the distinct vectors of some questions, and the indices of each question's vectors, its own first.
pub(super) fn distinct(questions: &[Question]) -> (Vec<&[f32]>, Vec<Vec<usize>>) {
    let mut distinct: Vec<&[f32]> = Vec::new();
    let mut place = |vector| {
        distinct.iter().position(|known| *known == vector).unwrap_or_else(|| {
            distinct.push(vector);
            distinct.len() - 1
        })
    };
    let places = questions.iter().map(|question| question.vectors().map(&mut place).collect()).collect();
    (distinct, places)
}

impl ShardScores {
    fn score(
        &mut self,
        instructions: InstructionSet,
        shard: &ShardView<'_>,
        vectors: &[Vector],
        places: &[Vec<usize>],
        precision: Precision,
    ) {
        self.projections.resize_with(vectors.len(), Projection::default);
        self.centroids.resize_with(vectors.len(), Vec::new);
        for ((projection, centroids), vector) in
            self.projections.iter_mut().zip(&mut self.centroids).zip(vectors)
        {
            projection.set(instructions, shard, vector);
            projection.score_centroids(instructions, shard, centroids);
            let are_codes_read = match precision {
                Precision::Centroids => false,
                Precision::Measured => true,
                Precision::Exact => shard.exact.is_none(),
            };
            if let Some(residuals) = shard.residuals.as_ref().filter(|_| are_codes_read) {
                projection.set_tables(residuals);
            }
            if let (Some(fine), true) = (shard.exact.and_then(|exact| exact.fine), are_codes_read) {
                projection.set_fine(&fine);
            }
        }
        self.combined.resize_with(places.len(), Vec::new);
        for (combined, places) in self.combined.iter_mut().zip(places) {
            combined.clear();
            let [own, negatives @ ..] = &places[..] else { continue };
            if !negatives.is_empty() {
                let of_centroid = |centroid: usize| {
                    combine(
                        self.centroids[*own][centroid],
                        negatives.iter().map(|n| self.centroids[*n][centroid]),
                    )
                };
                combined.extend((0..self.centroids[*own].len()).map(of_centroid));
            }
        }
    }
}

/// Returns a product minus the largest of its negatives' products. Never -0, which would sort after 0.
pub(super) fn combine(own: f32, negatives: impl Iterator<Item = f32>) -> f32 {
    negatives.reduce(f32::max).map_or(own, |worst| own - worst) + 0.0
}
