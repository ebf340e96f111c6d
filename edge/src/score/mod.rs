//! Scores questions against shards, centroid by centroid.
//!
//! A centroid's radius `r` bounds `||E_k - P[centroid]||` over its members, so a member's score lies within `r *
//! steepness` of the centroid's. The steepness is 1 for a plain cosine and `max_j ||q - n_j||` with negatives;
//! `project.rs` adds rounding errors. If a shard has a residual code or exact embeddings that the precision uses,
//! centroids above the threshold by more than that bound match as a whole, those below by more are skipped, and
//! members of those in between are scored individually. Otherwise a centroid matches by its own score, and the answer
//! states the bound.
//!
//! Hard bounds of codes are tens of times larger than their usual errors, so exact answers read most embeddings near
//! the threshold. With [`Precision::Measured`], codes decide all scores but those within a few of their measured
//! errors of the threshold, fine residuals all but those within a few of their own errors, and embeddings the rest.
//!
//! Scores of centroids and codes are integer sums, scaled once: they have the same bits on every processor.

mod budget;
mod cell;
mod collect;
mod dot;
mod objects;
mod project;
mod question;
mod region;
mod search;
mod select;
mod simd;

pub use budget::{Budget, MAX_COORDINATE, OverBudget, Pool, ScoreError};
pub use dot::{dot, rounding_bound};
pub use objects::{ObjectScores, score_objects};
pub use question::{Precision, Question, RELEVANCY_STEEPNESS, relevancy, score_of_relevancy};
pub use region::{Ball, MAX_CORNERS, Polygon, Region};
pub use search::{Effort, Hit, Matches, Run, Search};

#[cfg(test)]
mod coded_tests;
#[cfg(test)]
mod tests;
