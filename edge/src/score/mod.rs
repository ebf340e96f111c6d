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

mod bins;
mod cell;
mod centroids;
mod collect;
mod columns;
mod dot;
mod error;
mod matches;
mod objects;
mod precision;
mod project;
mod question;
mod region;
mod search;
mod select;
mod simd;

pub use columns::Columns;
pub use dot::{dot, rounding_bound};
pub use error::{MAX_COORDINATE, ScoreError};
pub use matches::{Effort, Hit, Matches, Run};
pub use objects::{ObjectScores, score_objects};
pub use precision::Precision;
pub use question::{Question, RELEVANCY_STEEPNESS, relevancy, score_of_relevancy};
pub use region::{Ball, Region};
pub use search::{Scratch, Search};
pub use simd::Level;

#[cfg(test)]
mod coded_tests;
#[cfg(test)]
mod tests;
