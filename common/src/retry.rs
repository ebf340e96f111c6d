//! Repeated attempts: how many, and the pauses between them.
//!
//! Not the crate `backon`: its count cannot restart after progress, which resumed downloads need, and here the caller
//! owns the pauses, ending them when cancelled or waiting as long as the server asks.

use std::time::Duration;

/// Pauses that double with each failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Backoff {
    /// Pause after the first failure.
    pub first: Duration,
    pub longest: Duration,
}

impl Backoff {
    /// Returns the pause after the `n_failures`-th failure in a row, counted from 1.
    pub fn after(&self, n_failures: u32) -> Duration {
        let factor = 1u32.checked_shl(n_failures.saturating_sub(1)).unwrap_or(u32::MAX);
        self.first.saturating_mul(factor).min(self.longest)
    }
}

/// Counts consecutive failures of one request.
#[derive(Clone, Debug)]
pub struct Retries {
    backoff: Backoff,
    max_attempts: u32,
    n_failures: u32,
}

impl Retries {
    pub fn new(max_attempts: u32, backoff: Backoff) -> Self {
        Self { backoff, max_attempts, n_failures: 0 }
    }

    /// Counts a failed attempt; progress restarts the count. Returns the pause before the next attempt, if any.
    pub fn failed(&mut self, made_progress: bool) -> Option<Duration> {
        self.n_failures = if made_progress { 1 } else { self.n_failures.saturating_add(1) };
        (self.n_failures < self.max_attempts).then(|| self.backoff.after(self.n_failures))
    }

    pub fn n_failures(&self) -> u32 {
        self.n_failures
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_up_to_the_longest_and_progress_starts_anew() {
        let ms = Duration::from_millis;
        let backoff = Backoff { first: ms(10), longest: ms(60) };
        let mut retries = Retries::new(5, backoff);
        let pauses = [(); 5].map(|()| retries.failed(false));
        assert_eq!(pauses, [Some(ms(10)), Some(ms(20)), Some(ms(40)), Some(ms(60)), None]);
        assert_eq!((retries.failed(true), retries.n_failures()), (Some(ms(10)), 1));
        assert_eq!(retries.failed(false), Some(ms(20)));
        assert_eq!(Retries::new(1, backoff).failed(true), None);
        assert_eq!([0, 1, 33, u32::MAX].map(|n| backoff.after(n)), [10, 10, 60, 60].map(ms));
        let unbounded = Backoff { first: Duration::MAX, longest: Duration::MAX };
        assert_eq!(unbounded.after(9), Duration::MAX);
    }
}
