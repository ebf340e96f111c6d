//! Scores questions against shards, codebook centroid by codebook centroid.
//!
//! A centroid's radius `r` bounds `||E_k - P[centroid]||` over its members, so a score of a member is within
//! `r * steepness` of the centroid's, where the steepness is 1 for a plain cosine and `max_j ||q - n_j||` with
//! negatives; what rounding adds is in `project.rs`. Where a shard knows more of a Gaussian than its centroid, a
//! residual code or the exact embedding (and that is asked for), centroids that stay at or above the threshold
//! by more than that are in as a whole, centroids below it by more are out, and only members of the centroids
//! between are scored one by one. Where it does not, a centroid is in when its own score reaches the threshold,
//! and the answer carries the bound.
//!
//! Hard bounds of codes are tens of times their usual errors, so that exact answers read most embeddings near the
//! border. With [`Precision::Measured`], codes decide all but what lies within a few of their measured errors
//! from it, fine residuals all of that but what lies within a few of theirs, and embeddings the rest.
//!
//! Scores of centroids and codes are sums of integers, scaled once: the same bits on every processor.

mod centroids;
mod collect;
mod columns;
mod dot;
mod objects;
mod project;
mod question;
mod region;
mod select;
mod simd;

use std::sync::{Arc, PoisonError};

use rayon::prelude::*;
use serde::Serialize;
use slag_common::shard::{ScoreErrors, ShardView};

use centroids::Scored;
use collect::{Cell, Cut, Gather, ShardGather};

pub use centroids::Scratch;
pub use columns::Columns;
pub use dot::{dot, rounding_bound};
pub use objects::{ObjectScores, score_objects};
pub use question::{Question, RELEVANCY_STEEPNESS, relevancy, score_of_relevancy};
pub use region::{Ball, Region};
pub use select::Hit;
pub use simd::Level;

/// Positions beyond this many world units are no scene (a hundred times the earth's diameter) and
/// would overflow what is computed from them.
pub const MAX_COORDINATE: f64 = 1e9;
/// How far a unit embedding stored as f16 may lie from the one its centroid's radius was measured to: half a
/// step of f16 at 1 (2^-11), and the steps of components too small for f16's exponents.
const F16_ROUNDING: f32 = 5e-4;

/// Why shards cannot be scored.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScoreError {
    /// The query vector is of another space.
    #[error(
        "cell {cell_id} holds embeddings of {expected} components, the query vector has {found}; use the models that the scene was encoded with"
    )]
    Dimension {
        /// The cell.
        cell_id: u32,
        /// Components of the shard.
        expected: usize,
        /// Components of the query.
        found: usize,
    },
    /// The query vector is not of unit length, or not finite.
    #[error("the query vector has length {found}, expected 1; the text model is damaged or of another kind")]
    NotUnit {
        /// Its length.
        found: f32,
    },
    /// A negative is of another space than the question.
    #[error(
        "a negative has {found} components, the query vector {expected}; take both from the same text model"
    )]
    Negative {
        /// Components of the query.
        expected: usize,
        /// Components of the negative.
        found: usize,
    },
    /// A shard's positions lie where no scene is.
    #[error(
        "cell {cell_id}: positions reach {found:e}, the limit is {MAX_COORDINATE:e} world units; encode the scene again around a nearer origin"
    )]
    Extent {
        /// The cell.
        cell_id: u32,
        /// Largest coordinate.
        found: f64,
    },
}

/// Which data scores come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Codebook centroids alone: fastest, every score within the bound stated.
    Centroids,
    /// As `Exact`, but of shards with exact embeddings only those are read that the measured errors of codes,
    /// and of fine residuals, leave near the border of the answer. Nearly all of the exact answer, tens of times
    /// sooner; [`Search::measured_errors`] says how near its scores are.
    Measured,
    /// Rows, and for what they cannot decide the residual codes or exact embeddings of shards that carry
    /// them.
    #[default]
    Exact,
}

impl Precision {
    /// Every precision, fastest first.
    pub const ALL: [Self; 3] = [Self::Centroids, Self::Measured, Self::Exact];

    /// Returns the name used in URLs and flags.
    pub fn name(self) -> &'static str {
        match self {
            Self::Centroids => "centroids",
            Self::Measured => "measured",
            Self::Exact => "exact",
        }
    }
}

impl std::fmt::Display for Precision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Precision {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = || Self::ALL.map(Self::name).join(", ");
        let found = Self::ALL.into_iter().find(|precision| precision.name() == text);
        found.ok_or_else(|| format!("{text:?} is no precision; there are: {}", names()))
    }
}

/// Matching Gaussians of one shard that lie next to each other and share a score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Run {
    /// Position of the shard in the searched slice.
    pub shard: u32,
    /// First member.
    pub start: u32,
    /// One past the last member.
    pub end: u32,
    /// Score of the centroid, or of the one Gaussian where it was scored by itself.
    pub score: f32,
}

/// Gaussians that reach a threshold.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matches {
    /// Runs, by shard and start, ascending; they do not overlap.
    pub runs: Vec<Run>,
    /// Gaussians in the runs.
    pub n_gaussians: u64,
    /// Rows that could only be decided member by member.
    pub n_centroids_undecided: u64,
    /// What finding them took.
    pub effort: Effort,
    /// Shards none of whose centroids can reach the threshold.
    pub n_shards_below: usize,
}

impl Matches {
    /// Empties the list; its memory stays.
    pub fn clear(&mut self) {
        let mut runs = std::mem::take(&mut self.runs);
        runs.clear();
        *self = Self { runs, ..Self::default() };
    }
}

/// What finding an answer took, beyond the centroids.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Effort {
    /// Gaussians that were scored by themselves.
    pub n_rescored: u64,
    /// Blocks of residual codes that were read.
    pub n_blocks_read: u64,
    /// Fine residuals that were read.
    pub n_fine_read: u64,
    /// Exact embeddings that were read.
    pub n_embeddings_read: u64,
}

impl std::ops::AddAssign for Effort {
    fn add_assign(&mut self, other: Self) {
        self.n_rescored += other.n_rescored;
        self.n_blocks_read += other.n_blocks_read;
        self.n_fine_read += other.n_fine_read;
        self.n_embeddings_read += other.n_embeddings_read;
    }
}

/// One question's centroid scores over some shards; gives several kinds of answers without scoring twice.
pub struct Search<'a> {
    shards: &'a [ShardView<'a>],
    question: &'a Question,
    region: Region,
    precision: Precision,
    scored: Arc<Scored>,
    /// Which of the vectors scored are the question's own and its negatives.
    places: Vec<usize>,
    /// Which of the questions scored it is.
    asked: usize,
    steepness: f32,
}

impl<'a> Search<'a> {
    /// Scores the centroids of the shards that reach into the region. As [`Search::batch`], for one question.
    ///
    /// # Errors
    /// [`ScoreError`].
    pub fn new(
        shards: &'a [ShardView<'a>],
        question: &'a Question,
        region: Region,
        precision: Precision,
    ) -> Result<Self, ScoreError> {
        Self::reusing(&mut Scratch::default(), shards, question, region, precision)
    }

    /// As [`Search::new`], in the memory of an earlier search that is over (else in new memory).
    ///
    /// # Errors
    /// [`ScoreError`].
    pub fn reusing(
        scratch: &mut Scratch,
        shards: &'a [ShardView<'a>],
        question: &'a Question,
        region: Region,
        precision: Precision,
    ) -> Result<Self, ScoreError> {
        check(shards, std::slice::from_ref(question))?;
        let places = scratch.take().score(shards, std::slice::from_ref(question), region, precision);
        let places = places.into_iter().next().unwrap_or_default();
        let (scored, steepness) = (scratch.share(), question.steepness());
        Ok(Self { shards, question, region, precision, scored, places, asked: 0, steepness })
    }

    /// Scores the centroids for several questions in one pass; returns a search for each, in their order.
    ///
    /// Costs one product per centroid, component and distinct vector (negatives that questions share are
    /// multiplied once), in parallel by shard.
    /// In the memory of earlier searches that are over (else in new memory).
    /// # Errors
    /// [`ScoreError`].
    pub fn batch(
        scratch: &mut Scratch,
        shards: &'a [ShardView<'a>],
        questions: &'a [Question],
        region: Region,
        precision: Precision,
    ) -> Result<Vec<Self>, ScoreError> {
        check(shards, questions)?;
        let places = scratch.take().score(shards, questions, region, precision);
        let searches = questions.iter().zip(places).enumerate().map(|(asked, (question, places))| {
            let (scored, steepness) = (scratch.share(), question.steepness());
            Self { shards, question, region, precision, scored, places, asked, steepness }
        });
        Ok(searches.collect())
    }

    /// Returns the Gaussians whose score reaches a threshold, as far as the shards' data tell.
    pub fn matching(&self, threshold: f32) -> Matches {
        let mut matches = Matches::default();
        self.matching_into(threshold, &mut matches);
        matches
    }

    /// As [`Search::matching`], into a list that is cleared before.
    pub fn matching_into(&self, threshold: f32, all: &mut Matches) {
        let mut gather = self.take_gather();
        self.collect(&mut gather, Cut { score: threshold, least: threshold }, false);
        all.clear();
        all.runs.reserve(gather.shards.iter().map(|of_shard| of_shard.found.runs.len()).sum());
        for ShardGather { found, .. } in &gather.shards {
            all.runs.extend_from_slice(&found.runs);
            all.n_gaussians += found.n_gaussians;
            all.n_centroids_undecided += found.n_centroids_undecided;
            all.effort += found.effort;
            all.n_shards_below += found.n_shards_below;
        }
        self.put_back(gather);
    }

    /// Returns the memory that answers are gathered in; new memory where another search of the batch has it.
    /// (A lock held over parallel work would block the thread that the other search is given to.)
    fn take_gather(&self) -> Gather {
        std::mem::take(&mut *self.scored.gather.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn put_back(&self, gather: Gather) {
        *self.scored.gather.lock().unwrap_or_else(PoisonError::into_inner) = gather;
    }

    /// Returns all shards, which runs and hits refer to by place.
    pub fn shards(&self) -> &'a [ShardView<'a>] {
        self.shards
    }

    /// Returns the shards that were searched (the others lie outside the region).
    pub fn searched(&self) -> impl Iterator<Item = &'a ShardView<'a>> {
        let searched = self.shards.iter().zip(&self.scored.shards).filter(|(_, scores)| scores.is_searched);
        searched.map(|(shard, _)| shard)
    }

    /// Returns the bound on the error of scores: none given here, of a centroid or a Gaussian, is off from
    /// that of any embedding it stands for by more.
    pub fn score_error_bound(&self) -> f32 {
        let cells = (0..self.shards.len()).into_par_iter().filter_map(|at| self.cell(at));
        let of_cell = |cell: Cell<'_>| {
            (0..cell.centroids.len()).map(|centroid| cell.score_error(centroid)).fold(0.0, f32::max)
        };
        cells.map(of_cell).reduce(|| 0.0, f32::max)
    }

    /// Returns the errors of scores that were measured over a bank of texts, each the largest of the shards
    /// searched; none where answers are exact, or a shard's were not measured for what is read of it.
    pub fn measured_errors(&self) -> Option<ScoreErrors> {
        let mut largest: Option<ScoreErrors> = None;
        for shard in self.searched() {
            let of_codes = match self.precision {
                Precision::Centroids => shard.residuals.is_none() && shard.exact.is_none(),
                Precision::Measured => true,
                Precision::Exact => shard.exact.is_none(),
            };
            let errors = shard.header.errors;
            if !of_codes || errors.p999 == 0.0 {
                return None;
            }
            let of = largest.unwrap_or(errors);
            largest = Some(ScoreErrors {
                mean: of.mean.max(errors.mean),
                p999: of.p999.max(errors.p999),
                max: of.max.max(errors.max),
                spread: of.spread.max(errors.spread),
            });
        }
        largest
    }

    /// Whether membership is exact: exact embeddings were asked for and every shard searched carries them.
    pub fn is_exact(&self) -> bool {
        self.precision == Precision::Exact && self.searched().all(|shard| shard.exact.is_some())
    }
}

fn check(shards: &[ShardView<'_>], questions: &[Question]) -> Result<(), ScoreError> {
    for question in questions {
        question.check()?;
        for shard in shards {
            let header = &shard.header;
            let (expected, found) = (header.dim as usize, question.vector.len());
            if expected != found {
                return Err(ScoreError::Dimension { cell_id: header.cell_id, expected, found });
            }
            let reach = shard.position_box();
            let found = reach.min.abs().max(reach.max.abs()).max_element();
            if found.is_nan() || found > MAX_COORDINATE {
                return Err(ScoreError::Extent { cell_id: header.cell_id, found });
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod coded_tests;
#[cfg(test)]
mod tests;
