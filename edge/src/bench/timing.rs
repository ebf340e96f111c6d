//! Parameters of a measurement of queries, and the times of one kind of answer.

use serde::Serialize;
use slag_math::stats::{self, Ordered, Rank};

use crate::score::Precision;

/// Parameters of the measurement.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Numbers of Gaussians to ask for.
    pub limits: Vec<usize>,
    /// Data that scores come from.
    pub precision: Precision,
    /// Timed queries for each limit and kind of answer; query vectors take turns.
    pub n_runs: usize,
    /// Untimed queries before them.
    pub n_warm_up: usize,
}

/// A kind of answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// The best `limit`, in order.
    Best,
    /// All that reach the score of the last of those.
    Threshold,
}

/// Times of one kind of answer at one limit.
#[derive(Clone, Debug, Serialize)]
pub struct Timing {
    /// Kind of answer.
    pub kind: Kind,
    /// Number of Gaussians asked for.
    pub limit: usize,
    /// Timed queries.
    pub n_runs: usize,
    /// Fewest and most Gaussians found.
    pub n_found: [usize; 2],
    /// Median time.
    pub median_ms: f64,
    /// 99th percentile.
    pub p99_ms: f64,
    /// Minimum.
    pub min_ms: f64,
    /// Share of the exact answer that is found, averaged over queries; absent if answers are exact or the
    /// shards have no exact embeddings.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recall: Option<f64>,
    /// Median number of bytes of the shards that a query reads.
    pub bytes_touched: u64,
    /// Time to read those bytes in a plain loop.
    pub plain_read_ms: f64,
    /// The median time divided by that.
    pub times_plain_read: f64,
}

/// Returns the least value that this share of the values does not exceed, in thousandths; 0 without any. It reorders the
/// values.
pub fn quantile<T: Ordered + Default>(values: &mut [T], per_mille: usize) -> T {
    stats::quantile(values, per_mille, Rank::Nearest).unwrap_or_default()
}
