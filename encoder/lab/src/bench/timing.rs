//! Timings and their spread.

use std::time::Instant;

use serde::Serialize;
use slag_math::stats::{Rank, quantile};

/// Several timings of the same work.
#[derive(Clone, Debug, Serialize)]
pub struct Spread {
    /// Number of timings.
    pub n: usize,
    /// Fastest, milliseconds.
    pub min_ms: f64,
    /// 10th percentile, milliseconds.
    pub p10_ms: f64,
    /// Median, milliseconds.
    pub median_ms: f64,
    /// 90th percentile, milliseconds.
    pub p90_ms: f64,
    /// Slowest, milliseconds.
    pub max_ms: f64,
}

impl Spread {
    /// Summarises timings.
    ///
    /// # Panics
    /// Without any.
    pub fn of(mut timings_ms: Vec<f64>) -> Self {
        let n = timings_ms.len();
        let mut at = |per_mille| quantile(&mut timings_ms, per_mille, Rank::Nearest).expect("has timings");
        Self { n, min_ms: at(0), p10_ms: at(100), median_ms: at(500), p90_ms: at(900), max_ms: at(1000) }
    }
}

/// Runs a piece of work and returns its result and duration in milliseconds.
pub fn timed_ms<T>(work: impl FnOnce() -> T) -> (T, f64) {
    let start = Instant::now();
    let result = work();
    (result, start.elapsed().as_secs_f64() * 1e3)
}
