//! What every step of a run needs: progress, cancellation, times and threads.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use rayon::ThreadPool;

use super::error::EncodeError;
use crate::progress::Progress;

/// Stack of a worker thread: while it waits for others' part of its work, a worker may take up another view.
const STACK_BYTES: usize = 8 << 20;

/// The time spent in each stage, added over all threads.
#[derive(Default)]
struct StageTimes(Mutex<BTreeMap<&'static str, f64>>);

/// The state that the steps of one run share.
///
/// Threads belong to the run: two encodes in one process do not share them, and rayon's global pool stays as it is.
pub(super) struct RunContext<'a> {
    start: Instant,
    progress: &'a dyn Progress,
    cancel: &'a AtomicBool,
    times: StageTimes,
    pool: ThreadPool,
}

impl<'a> RunContext<'a> {
    /// Starts `n_threads` worker threads.
    ///
    /// # Errors
    /// [`EncodeError::Threads`].
    pub(super) fn new(
        n_threads: usize,
        progress: &'a dyn Progress,
        cancel: &'a AtomicBool,
    ) -> Result<Self, EncodeError> {
        let start = Instant::now();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).stack_size(STACK_BYTES).build();
        let pool = pool.map_err(|source| EncodeError::Threads { n_threads, source })?;
        Ok(Self { start, progress, cancel, times: StageTimes::default(), pool })
    }

    /// Returns when the run began.
    pub(super) fn start(&self) -> Instant {
        self.start
    }

    /// Returns the receiver of progress.
    pub(super) fn progress(&self) -> &'a dyn Progress {
        self.progress
    }

    /// Returns the flag that asks the run to stop, for steps that poll it themselves.
    pub(super) fn cancel(&self) -> &'a AtomicBool {
        self.cancel
    }

    /// Returns whether the user has asked the run to stop.
    pub(super) fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }

    /// Returns the run's threads, for a step that waits for a device and needs them only in between.
    pub(super) fn pool(&self) -> &ThreadPool {
        &self.pool
    }

    /// Runs work on the run's threads: parallel iterators inside use these alone.
    pub(super) fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.pool.install(work)
    }

    /// Runs work and adds its time to a stage.
    pub(super) fn time<T>(&self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        let secs = start.elapsed().as_secs_f64();
        *self.times.0.lock().unwrap_or_else(PoisonError::into_inner).entry(stage).or_default() += secs;
        result
    }

    /// Returns the seconds spent in each stage so far.
    pub(super) fn busy_secs(&self) -> BTreeMap<String, f64> {
        let times = self.times.0.lock().unwrap_or_else(PoisonError::into_inner);
        times.iter().map(|(stage, secs)| ((*stage).to_owned(), *secs)).collect()
    }
}
