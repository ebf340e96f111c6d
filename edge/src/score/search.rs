//! Searches: one or several questions over a set of shards.

use std::sync::{Arc, Mutex, PoisonError};

use glam::DVec3;
use rayon::prelude::*;
use slag_common::shard::{ScoreErrors, ShardView};

use super::budget::{Budget, ScoreError};
use super::cell::Cell;
use super::centroids::{AskedQuestion, CentroidScores};
use super::collect::{Cut, ShardGather};
use super::matches::{Hit, Matches};
use super::question::{Precision, Question, check};
use super::region::Region;
use super::select::AnswerBuffers;

/// A search's budget, and buffers for the next search to reuse, so that little but answers is allocated.
#[derive(Default)]
pub struct Scratch {
    budget: Budget,
    scored: Arc<CentroidScores>,
    buffers: Arc<Mutex<AnswerBuffers>>,
}

impl Scratch {
    /// Sets the budget of later searches; unlimited by default.
    pub(crate) fn set_budget(&mut self, budget: Budget) {
        self.budget = budget;
    }

    pub fn budget(&self) -> &Budget {
        &self.budget
    }

    /// Charges the centroids' scores to the budget.
    fn take_scores(&self, shards: &[ShardView<'_>], questions: &[Question]) -> Result<(), ScoreError> {
        let n_centroids: usize = shards.iter().map(|shard| shard.header.n_centroids as usize).sum();
        let n_vectors: usize = questions.iter().map(|question| question.vectors().count()).sum();
        self.budget.take(n_centroids * n_vectors * size_of::<f32>());
        Ok(self.budget.check()?)
    }

    /// Returns unshared buffers: those of the last search if it is over, else new ones.
    fn take(&mut self) -> &mut CentroidScores {
        if Arc::get_mut(&mut self.scored).is_none() {
            *self = Self { budget: std::mem::take(&mut self.budget), ..Self::default() };
        }
        Arc::get_mut(&mut self.scored).unwrap_or_else(|| unreachable!("the only owner"))
    }

    fn search<'a>(&self, asked: AskedQuestion<'a>) -> Search<'a> {
        Search { asked, buffers: Arc::clone(&self.buffers) }
    }

    #[cfg(test)]
    pub(crate) fn is_untouched(&self) -> bool {
        self.scored.shards.is_empty()
    }
}

/// One question's centroid scores over a set of shards, reusable for several kinds of answers.
pub struct Search<'a> {
    pub(super) asked: AskedQuestion<'a>,
    /// Shared by the searches of a batch.
    buffers: Arc<Mutex<AnswerBuffers>>,
}

impl<'a> Search<'a> {
    /// [`Search::batch`] for one question.
    pub fn new(
        shards: &'a [ShardView<'a>],
        question: &'a Question,
        region: Region,
        precision: Precision,
    ) -> Result<Self, ScoreError> {
        Self::reusing(&mut Scratch::default(), shards, question, region, precision)
    }

    /// As [`Search::new`], in the buffers of an earlier search if that is over.
    pub fn reusing(
        scratch: &mut Scratch,
        shards: &'a [ShardView<'a>],
        question: &'a Question,
        region: Region,
        precision: Precision,
    ) -> Result<Self, ScoreError> {
        let mut searches = Self::batch(scratch, shards, std::slice::from_ref(question), region, precision)?;
        Ok(searches.swap_remove(0))
    }

    /// Scores the centroids for several questions in one pass; returns a search for each, in their order.
    ///
    /// Costs one product per centroid, component and distinct vector (shared negatives are multiplied once), in
    /// parallel by shard. Reuses the buffers of earlier searches if those are over.
    pub fn batch(
        scratch: &mut Scratch,
        shards: &'a [ShardView<'a>],
        questions: &'a [Question],
        region: Region,
        precision: Precision,
    ) -> Result<Vec<Self>, ScoreError> {
        check(shards, questions)?;
        scratch.take_scores(shards, questions)?;
        let places = scratch.take().score(shards, questions, region.clone(), precision);
        let searches = questions.iter().zip(places).enumerate().map(|(index, (question, places))| {
            scratch.search(AskedQuestion {
                shards,
                question,
                region: region.clone(),
                precision,
                scored: Arc::clone(&scratch.scored),
                budget: scratch.budget.clone(),
                places,
                index,
                steepness: question.steepness(),
            })
        });
        Ok(searches.collect())
    }

    /// Returns the Gaussians with scores at or above a threshold, as far as the shards' data decide.
    pub fn matching(&self, threshold: f32) -> Matches {
        let mut all = Matches::default();
        let mut buffers = self.take_buffers();
        let gather = &mut buffers.gather;
        self.asked.collect(gather, Cut { score: threshold, least: threshold }, false);
        all.runs.reserve(gather.shards.iter().map(|of_shard| of_shard.found.runs.len()).sum());
        for ShardGather { found, .. } in &gather.shards {
            all.runs.extend_from_slice(&found.runs);
            all.n_gaussians += found.n_gaussians;
            all.n_centroids_undecided += found.n_centroids_undecided;
            all.effort += found.effort;
            all.n_shards_below += found.n_shards_below;
        }
        self.put_back(buffers);
        all
    }

    /// Returns the `limit` best Gaussians that reach a threshold, best first: by score, then by distance from `near`,
    /// then by cell and index. The selection is exact with respect to the scores returned.
    pub fn best(&self, limit: usize, threshold: f32, near: Option<DVec3>) -> Vec<Hit> {
        let mut buffers = self.take_buffers();
        let hits = self.asked.best(&mut buffers, limit, threshold, near);
        self.put_back(buffers);
        hits
    }

    /// Takes the shared buffers, or empty ones while another search of the batch uses them. (A lock held over
    /// parallel work would block the thread that the other search is scheduled on.)
    fn take_buffers(&self) -> AnswerBuffers {
        std::mem::take(&mut *self.buffers.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn put_back(&self, buffers: AnswerBuffers) {
        *self.buffers.lock().unwrap_or_else(PoisonError::into_inner) = buffers;
    }

    /// Returns all shards; runs and hits refer to them by index.
    pub fn shards(&self) -> &'a [ShardView<'a>] {
        self.asked.shards
    }

    pub fn searched(&self) -> impl Iterator<Item = &'a ShardView<'a>> {
        let searched =
            self.asked.shards.iter().zip(&self.asked.scored.shards).filter(|(_, scores)| scores.is_searched);
        searched.map(|(shard, _)| shard)
    }

    /// Bounds every score's difference from the score of any embedding that the centroid or Gaussian represents.
    pub fn score_error_bound(&self) -> f32 {
        let cells = (0..self.asked.shards.len()).into_par_iter().filter_map(|at| self.asked.cell(at));
        let of_cell = |cell: Cell<'_>| {
            (0..cell.centroids.len()).map(|centroid| cell.score_error(centroid)).fold(0.0, f32::max)
        };
        cells.map(of_cell).reduce(|| 0.0, f32::max)
    }

    /// Returns the score errors measured over a bank of texts, each the maximum over the shards searched, so that the
    /// likely one holds for each; `None` if answers are exact, or a shard lacks measurements for the data read.
    pub(crate) fn measured_errors(&self) -> Option<ScoreErrors> {
        let mut largest: Option<ScoreErrors> = None;
        for shard in self.searched() {
            let of_codes = match self.asked.precision {
                Precision::Centroids => shard.residuals.is_none() && shard.exact.is_none(),
                Precision::Measured => true,
                Precision::Exact => shard.exact.is_none(),
            };
            let errors = shard.header.errors;
            if !of_codes || errors.likely == 0.0 {
                return None;
            }
            let of = largest.unwrap_or(errors);
            largest = Some(ScoreErrors {
                mean: of.mean.max(errors.mean),
                likely: of.likely.max(errors.likely),
                max: of.max.max(errors.max),
                spread: of.spread.max(errors.spread),
            });
        }
        largest
    }

    /// Returns whether membership is exact: exact embeddings are asked for and present in every shard searched.
    pub fn is_exact(&self) -> bool {
        self.asked.precision == Precision::Exact && self.searched().all(|shard| shard.exact.is_some())
    }
}
