//! What a measurement of questions is asked for, and the times of one kind of answer.

use serde::Serialize;

use crate::score::Precision;

/// What is measured.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Result sizes.
    pub limits: Vec<usize>,
    /// Which data scores come from.
    pub precision: Precision,
    /// Timed questions for each size and kind of answer; queries take turns.
    pub n_runs: usize,
    /// Untimed questions before them.
    pub n_warm_up: usize,
}

/// A kind of answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// The best so many, in order.
    Best,
    /// All that reach the score of the last of those.
    Threshold,
}

/// Times of one kind of answer at one size.
#[derive(Clone, Debug, Serialize)]
pub struct Timing {
    /// Kind of answer.
    pub kind: Kind,
    /// Size asked for.
    pub limit: usize,
    /// Timed questions.
    pub n_runs: usize,
    /// Fewest and most Gaussians found.
    pub n_found: [usize; 2],
    /// Half of the questions took no longer.
    pub median_ms: f64,
    /// 99 of 100 took no longer.
    pub p99_ms: f64,
    /// The shortest.
    pub min_ms: f64,
    /// Share of the exact answer that is found, mean over queries; absent where answers are exact, or the shards
    /// have no exact embeddings to tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recall: Option<f64>,
    /// Bytes of the shards that a question reads, median.
    pub bytes_touched: u64,
    /// What reading those takes in a plain loop.
    pub plain_read_ms: f64,
    /// The median by that.
    pub times_plain_read: f64,
}

/// Returns the least of some sorted values, at least one, that so large a share of them does not exceed.
pub fn quantile<T: Copy>(sorted: &[T], share: f64) -> T {
    sorted[((sorted.len() as f64 * share).ceil() as usize).clamp(1, sorted.len()) - 1]
}
