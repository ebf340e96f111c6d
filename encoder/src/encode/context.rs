//! What every step of a run needs: progress, cancellation, times and threads.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use slag_models::{ModelDir, SessionOptions};

use super::error::EncodeError;
use super::report::PhaseReport;
use crate::memory::{self, Phase};
use crate::progress::Progress;
use crate::raster::Rasterizer;

#[derive(Clone, Copy)]
pub struct Engines<'a> {
    pub models: &'a ModelDir,
    pub session: &'a SessionOptions,
    pub rasterizer: &'a dyn Rasterizer,
}

impl<'a> Engines<'a> {
    pub fn new(models: &'a ModelDir, session: &'a SessionOptions, rasterizer: &'a dyn Rasterizer) -> Self {
        Self { models, session, rasterizer }
    }
}

struct Began {
    phase: Phase,
    at: Instant,
    /// The process's peak memory until then, bytes.
    peak_before: Option<u64>,
}

pub(crate) struct RunContext<'a> {
    pub(super) start: Instant,
    pub(crate) progress: &'a dyn Progress,
    pub(crate) cancel: &'a AtomicBool,
    /// Seconds by stage, added over threads.
    times: Mutex<BTreeMap<&'static str, f64>>,
    phases: Mutex<Vec<Began>>,
    pub(crate) workers: Workers,
}

impl<'a> RunContext<'a> {
    pub(crate) fn new(
        n_threads: usize,
        progress: &'a dyn Progress,
        cancel: &'a AtomicBool,
    ) -> Result<Self, EncodeError> {
        let start = Instant::now();
        let failed = |error| format!("cannot start {n_threads} threads: {error}; use fewer with --threads");
        let workers = Workers::start(n_threads).map_err(|error| EncodeError::Failed(failed(error)))?;
        let phases = Mutex::new(vec![Began { phase: Phase::Read, at: start, peak_before: None }]);
        Ok(Self { start, progress, cancel, times: Mutex::default(), phases, workers })
    }

    pub(super) fn begin_phase(&self, phase: Phase) {
        // Before the phase allocates, so that phases' memory does not add up.
        memory::give_back();
        let began = Began { phase, at: Instant::now(), peak_before: memory::peak_bytes() };
        self.phases.lock().unwrap_or_else(PoisonError::into_inner).push(began);
    }

    /// Phases so far, the last one until `end`: they add up to the time since the start.
    pub(super) fn phases(&self, end: Instant) -> Vec<PhaseReport> {
        let phases = self.phases.lock().unwrap_or_else(PoisonError::into_inner);
        let began = phases.iter().skip(1).map(|Began { at, peak_before, .. }| (*at, *peak_before));
        let ends = began.chain([(end, memory::peak_bytes())]);
        let report = |(Began { phase, at, .. }, (ended, peak_bytes)): (&Began, _)| PhaseReport {
            phase: *phase,
            secs: Instant::duration_since(&ended, *at).as_secs_f64(),
            peak_bytes,
        };
        phases.iter().zip(ends).map(report).collect()
    }

    pub(crate) fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }

    /// Runs work, with its parallel iterators, on the run's threads only.
    pub(crate) fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.workers.run(false, work)
    }

    pub(crate) fn time<T>(&self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        let secs = start.elapsed().as_secs_f64();
        *self.times.lock().unwrap_or_else(PoisonError::into_inner).entry(stage).or_default() += secs;
        result
    }

    pub(crate) fn busy_secs(&self) -> BTreeMap<String, f64> {
        let times = self.times.lock().unwrap_or_else(PoisonError::into_inner);
        times.iter().map(|(stage, secs)| ((*stage).to_owned(), *secs)).collect()
    }
}

/// While a thread waits for parts of its work, it may take up another piece on the same stack.
const STACK_BYTES: usize = 8 << 20;

pub(crate) struct Workers {
    /// For work on all threads, and steps that wait for a device and need threads in between.
    pub(crate) shared: ThreadPool,
    /// Idle pools of one thread, made as needed.
    alone: Mutex<Vec<ThreadPool>>,
}

fn start(n_threads: usize) -> Result<ThreadPool, ThreadPoolBuildError> {
    ThreadPoolBuilder::new().num_threads(n_threads).stack_size(STACK_BYTES).build()
}

impl Workers {
    pub(crate) fn start(n_threads: usize) -> Result<Self, ThreadPoolBuildError> {
        Ok(Self { shared: start(n_threads)?, alone: Mutex::default() })
    }

    /// Returns how many of the first `n_pieces` get a thread of their own, with `n_at_once` worked on at a time.
    pub(crate) fn n_alone(&self, n_pieces: usize, n_at_once: usize) -> usize {
        let n_threads = self.shared.current_num_threads();
        // Fewer pieces than threads would leave threads idle.
        if n_threads == 1 || n_at_once < n_threads { 0 } else { n_pieces - n_pieces % n_at_once }
    }

    /// Runs work on one thread of its own, or on all threads; the caller only waits.
    pub(crate) fn run<T: Send>(&self, is_alone: bool, work: impl FnOnce() -> T + Send) -> T {
        let free = || self.alone.lock().unwrap_or_else(PoisonError::into_inner);
        let pool = is_alone.then(|| free().pop().map_or_else(|| start(1), Ok));
        match pool {
            Some(Ok(pool)) => {
                let result = pool.install(work);
                free().push(pool);
                result
            }
            // If the system refuses another thread, the shared ones do it.
            Some(Err(_)) | None => self.shared.install(work),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use rayon::prelude::*;

    use super::*;

    /// Pieces that wait for each other end only if each has its own thread, which does all of its parts.
    #[test]
    fn each_piece_has_a_thread_of_its_own() {
        let workers = Workers::start(3).expect("starts");
        let all_began = Barrier::new(3);
        std::thread::scope(|scope| {
            for _ in 0..3 {
                scope.spawn(|| {
                    workers.run(true, || {
                        all_began.wait();
                        let of_parts = (0..100).into_par_iter().map(|_| std::thread::current().id());
                        let own = std::thread::current().id();
                        assert!(of_parts.collect::<Vec<_>>().iter().all(|id| *id == own));
                    });
                });
            }
        });
        assert_eq!(workers.alone.lock().expect("not poisoned").len(), 3, "they are used again");
        workers.run(false, || assert_eq!(rayon::current_num_threads(), 3));
    }

    #[test]
    fn the_last_pieces_are_shared() {
        let workers = Workers::start(4).expect("starts");
        assert_eq!([0, 3, 4, 7, 8].map(|n| workers.n_alone(n, 4)), [0, 0, 4, 4, 8]);
        assert_eq!(workers.n_alone(9, 3), 0, "a thread would have no work");
        assert_eq!(Workers::start(1).expect("starts").n_alone(9, 1), 0);
    }
}
