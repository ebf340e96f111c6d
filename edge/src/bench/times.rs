//! Distributions of request times.

use serde::Serialize;

/// Times of many requests, in buckets 2 % wide: memory does not grow with the length of a run.
#[derive(Clone, Debug)]
pub struct Times {
    counts: Vec<u64>,
    max_us: u64,
}

/// Percentiles of measured times, milliseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Percentiles {
    /// Requests.
    pub n: u64,
    /// Median.
    pub median_ms: f64,
    /// 99th percentile.
    pub p99_ms: f64,
    /// Maximum.
    pub max_ms: f64,
}

const BUCKET_RATIO: f64 = 1.02;
/// Reaches beyond an hour.
const N_BUCKETS: usize = 1200;

impl Default for Times {
    fn default() -> Self {
        Self { counts: vec![0; N_BUCKETS], max_us: 0 }
    }
}

impl Times {
    pub fn add(&mut self, took: std::time::Duration) {
        let us = u64::try_from(took.as_micros()).unwrap_or(u64::MAX);
        let bucket = (us.max(1) as f64).ln() / BUCKET_RATIO.ln();
        self.counts[(bucket as usize).min(N_BUCKETS - 1)] += 1;
        self.max_us = self.max_us.max(us);
    }

    pub fn merge(&mut self, other: &Self) {
        self.counts.iter_mut().zip(&other.counts).for_each(|(a, b)| *a += b);
        self.max_us = self.max_us.max(other.max_us);
    }

    pub fn percentiles(&self) -> Percentiles {
        let n: u64 = self.counts.iter().sum();
        let max_ms = self.max_us as f64 / 1e3;
        let at = |share: f64| {
            let (wanted, mut seen) = ((n as f64 * share).ceil() as u64, 0);
            let bucket = self.counts.iter().position(|count| {
                seen += count;
                seen >= wanted
            });
            bucket.map_or(0.0, |bucket| BUCKET_RATIO.powi(bucket as i32 + 1) / 1e3).min(max_ms)
        };
        Percentiles { n, median_ms: at(0.5), p99_ms: at(0.99), max_ms }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the sorted times themselves.
    #[test]
    fn percentiles_are_within_a_bucket() {
        let mut all: Vec<u64> = (0..10_000u64).map(|i| 20 + i * i % 90_007).collect();
        let (mut first, mut second) = (Times::default(), Times::default());
        for (i, us) in all.iter().enumerate() {
            if i % 3 == 0 { &mut first } else { &mut second }.add(std::time::Duration::from_micros(*us));
        }
        first.merge(&second);
        all.sort_unstable();
        let found = first.percentiles();
        for (found, expected) in [(found.median_ms, all[4999]), (found.p99_ms, all[9899])] {
            let expected = expected as f64 / 1e3;
            assert!(found >= expected && found <= expected * 1.021, "{found} {expected}");
        }
        assert_eq!((found.n, found.max_ms), (10_000, all[9999] as f64 / 1e3));
        assert_eq!(Times::default().percentiles(), Percentiles::default());
    }
}
