//! A request's budget of bytes and time, checked during scoring and clustering.
//!
//! Work on several threads cannot return an error from every loop, so a budget latches: once it is spent, loops end
//! early, and the caller checks [`Budget::check`] before using the result.

use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum OverBudget {
    #[error(
        "the query needs more than {bytes} bytes of memory, its budget; raise threshold, min_count or voxel, lower limit, or ask for a smaller radius, box or photo"
    )]
    Bytes { bytes: u64 },
    #[error(
        "the queries in progress need more than {bytes} bytes of memory, their budget together; ask again"
    )]
    Together { bytes: u64 },
    #[error(
        "the query took more than {} s, its budget; raise threshold, min_count or voxel, or ask for a smaller radius or box",
        time.as_secs_f64()
    )]
    Time { time: Duration },
}

#[derive(Debug)]
pub struct Pool {
    bytes: u64,
    used: AtomicU64,
}

impl Pool {
    pub fn new(bytes: u64) -> Arc<Self> {
        Arc::new(Self { bytes, used: AtomicU64::new(0) })
    }

    pub fn used_bytes(&self) -> u64 {
        self.used.load(Relaxed)
    }
}

/// The remaining budget of a request; unlimited by default. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct Budget(Option<Arc<Account>>);

#[derive(Debug)]
struct Account {
    bytes: u64,
    time: Duration,
    started: Instant,
    pool: Arc<Pool>,
    used: AtomicU64,
    spent: OnceLock<OverBudget>,
}

impl Budget {
    pub fn new(bytes: u64, time: Duration, pool: &Arc<Pool>) -> Self {
        let (started, pool, used) = (Instant::now(), Arc::clone(pool), AtomicU64::new(0));
        Self(Some(Arc::new(Account { bytes, time, started, pool, used, spent: OnceLock::new() })))
    }

    /// Takes bytes. Returns whether work may go on.
    pub fn take(&self, bytes: usize) -> bool {
        let Some(account) = &self.0 else { return true };
        let bytes = bytes as u64;
        let used = account.used.fetch_add(bytes, Relaxed).saturating_add(bytes);
        let together = account.pool.used.fetch_add(bytes, Relaxed).saturating_add(bytes);
        if used > account.bytes {
            account.spend(OverBudget::Bytes { bytes: account.bytes });
        } else if together > account.pool.bytes {
            account.spend(OverBudget::Together { bytes: account.pool.bytes });
        }
        self.goes_on()
    }

    /// Takes bytes if both bytes and time allow it; returns whether it did.
    pub fn try_take(&self, bytes: usize) -> bool {
        let Some(account) = &self.0 else { return true };
        let left = |limit: u64, used: &AtomicU64| limit.saturating_sub(used.load(Relaxed)) >= bytes as u64;
        let has_room = left(account.bytes, &account.used) && left(account.pool.bytes, &account.pool.used);
        has_room && self.take(bytes)
    }

    pub fn used_bytes(&self) -> u64 {
        self.0.as_ref().map_or(0, |account| account.used.load(Relaxed))
    }

    /// Returns the bytes taken since `used_bytes` had this value, except `kept`.
    pub(crate) fn give_back_to(&self, used_bytes: u64, kept: usize) {
        let Some(account) = &self.0 else { return };
        let bytes = self.used_bytes().saturating_sub(used_bytes.saturating_add(kept as u64));
        account.used.fetch_sub(bytes, Relaxed);
        account.pool.used.fetch_sub(bytes, Relaxed);
    }

    pub fn goes_on(&self) -> bool {
        let Some(account) = &self.0 else { return true };
        if account.spent.get().is_none() && account.started.elapsed() > account.time {
            account.spend(OverBudget::Time { time: account.time });
        }
        account.spent.get().is_none()
    }

    /// Returns an error if bytes or time are spent.
    pub fn check(&self) -> Result<(), OverBudget> {
        match self.0.as_ref().filter(|_| !self.goes_on()).and_then(|account| account.spent.get()) {
            Some(spent) => Err(spent.clone()),
            None => Ok(()),
        }
    }
}

impl Account {
    /// The first reason stays.
    fn spend(&self, why: OverBudget) {
        let _ = self.spent.set(why);
    }
}

impl Drop for Account {
    fn drop(&mut self) {
        self.pool.used.fetch_sub(*self.used.get_mut(), Relaxed);
    }
}

/// Largest coordinate, world units: a hundred times the earth's diameter; computations with more would overflow.
pub const MAX_COORDINATE: f64 = 1e9;

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScoreError {
    #[error(transparent)]
    OverBudget(#[from] OverBudget),
    /// A question or a scene that cannot be scored.
    #[error("{0}")]
    Unfit(String),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_and_time_are_spent_once_and_given_back() {
        let (pool, hour) = (Pool::new(100), Duration::from_secs(3600));
        let first = Budget::new(70, hour, &pool);
        assert!(first.take(40) && first.clone().take(20) && first.check().is_ok());
        let before = first.used_bytes();
        assert!(first.take(10));
        first.give_back_to(before, 3);
        assert_eq!((first.used_bytes(), pool.used_bytes()), (63, 63));
        assert!(!first.try_take(8) && first.check().is_ok());
        assert!(!first.take(8));
        assert_eq!(first.check(), Err(OverBudget::Bytes { bytes: 70 }));
        first.give_back_to(0, 0);
        assert_eq!(first.check(), Err(OverBudget::Bytes { bytes: 70 }), "it stays spent");

        let (second, third) = (Budget::new(70, hour, &pool), Budget::new(70, hour, &pool));
        assert!(second.take(60) && !third.take(50));
        assert_eq!(third.check(), Err(OverBudget::Together { bytes: 100 }));
        drop((first, second, third));
        assert_eq!(pool.used_bytes(), 0);

        let late = Budget::new(70, Duration::ZERO, &pool);
        std::thread::sleep(Duration::from_millis(1));
        assert!(!late.goes_on());
        assert_eq!(late.check(), Err(OverBudget::Time { time: Duration::ZERO }));
        assert!(Budget::default().take(usize::MAX) && Budget::default().check().is_ok());
    }
}
