//! What every step of a run needs: progress, cancellation, times and threads.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use rayon::ThreadPool;

use super::error::EncodeError;
use super::report::{Phase, PhaseReport};
use super::workers::Workers;
use crate::memory;
use crate::progress::Progress;

/// The time spent in each stage, added over all threads.
#[derive(Default)]
struct StageTimes(Mutex<BTreeMap<&'static str, f64>>);

/// The beginning of a phase.
struct Began {
    phase: Phase,
    at: Instant,
    /// The most memory of the process until then, bytes.
    peak_before: Option<u64>,
}

/// The state that the steps of one run share.
pub(crate) struct RunContext<'a> {
    start: Instant,
    progress: &'a dyn Progress,
    cancel: &'a AtomicBool,
    times: StageTimes,
    phases: Mutex<Vec<Began>>,
    workers: Workers,
}

impl<'a> RunContext<'a> {
    /// Starts `n_threads` worker threads.
    pub(crate) fn new(
        n_threads: usize,
        progress: &'a dyn Progress,
        cancel: &'a AtomicBool,
    ) -> Result<Self, EncodeError> {
        let start = Instant::now();
        let workers =
            Workers::start(n_threads).map_err(|source| EncodeError::Threads { n_threads, source })?;
        let phases = Mutex::new(vec![Began { phase: Phase::Read, at: start, peak_before: None }]);
        Ok(Self { start, progress, cancel, times: StageTimes::default(), phases, workers })
    }

    /// Ends the present phase and begins the next.
    pub(super) fn begin_phase(&self, phase: Phase) {
        // Before anything of the phase is there, so that phases do not come on top of each other.
        memory::give_back();
        let began = Began { phase, at: Instant::now(), peak_before: memory::peak_bytes() };
        self.phases.lock().unwrap_or_else(PoisonError::into_inner).push(began);
    }

    /// Returns the phases so far, of which the last one ends at `end`: they add up to the time since the start.
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

    /// Returns when the run began.
    pub(super) fn start(&self) -> Instant {
        self.start
    }

    pub(crate) fn progress(&self) -> &'a dyn Progress {
        self.progress
    }

    /// Returns the flag that asks the run to stop, for steps that poll it themselves.
    pub(crate) fn cancel(&self) -> &'a AtomicBool {
        self.cancel
    }

    /// Returns whether the user has asked the run to stop.
    pub(crate) fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }

    /// Returns the run's threads, for a step that waits for a device and needs them only in between.
    pub(crate) fn pool(&self) -> &ThreadPool {
        self.workers.shared()
    }

    /// Returns the run's threads.
    pub(crate) fn workers(&self) -> &Workers {
        &self.workers
    }

    /// Runs work on the run's threads: parallel iterators inside use these alone.
    pub(crate) fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.workers.run(false, work)
    }

    pub(crate) fn time<T>(&self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        let secs = start.elapsed().as_secs_f64();
        *self.times.0.lock().unwrap_or_else(PoisonError::into_inner).entry(stage).or_default() += secs;
        result
    }

    /// Returns the seconds spent in each stage so far.
    pub(crate) fn busy_secs(&self) -> BTreeMap<String, f64> {
        let times = self.times.0.lock().unwrap_or_else(PoisonError::into_inner);
        times.iter().map(|(stage, secs)| ((*stage).to_owned(), *secs)).collect()
    }
}
