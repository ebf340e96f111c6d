//! The coordinator's sign of life: without it, workers would wait for ever for one that died for good.
//!
//! Workers compare what they read with what they read before, by their own clocks: those of the machines may differ.

use std::sync::Arc;
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::time::{Duration, Instant};

use super::error::FleetError;
use super::run::Run;
use crate::blobs::Bucket;

/// Time between two signs, and between two looks at them.
const BEAT: Duration = Duration::from_secs(10);

/// Gives signs until it is dropped.
pub(super) struct Heart {
    _stop: Sender<()>,
}

impl Heart {
    /// Begins to give signs for a run.
    pub(super) fn start(bucket: &Arc<Bucket>, run: Run) -> Self {
        let (stop, stopped) = mpsc::channel();
        let bucket = Arc::clone(bucket);
        std::thread::spawn(move || {
            let mut n_beats = 0u64;
            while stopped.recv_timeout(if n_beats == 0 { Duration::ZERO } else { BEAT })
                == Err(RecvTimeoutError::Timeout)
            {
                n_beats += 1;
                if let Err(error) = bucket.put(&run.pulse_key(), n_beats.to_string()) {
                    tracing::warn!("no sign of life: {error}");
                }
            }
        });
        Self { _stop: stop }
    }
}

/// What a worker has seen of a coordinator's signs.
pub(super) struct Pulse {
    run: Run,
    patience: Duration,
    /// The last sign, since when it is known, and the last look.
    last: Option<Vec<u8>>,
    since: Instant,
    looked: Option<Instant>,
}

impl Pulse {
    /// Begins to look. `patience`: time without a new sign after which the coordinator counts as gone.
    pub(super) fn new(run: Run, patience: Duration) -> Self {
        Self { run, patience, last: None, since: Instant::now(), looked: None }
    }

    /// Looks for a new sign, if it is time to.
    ///
    /// # Errors
    /// [`FleetError::Abandoned`]; [`FleetError::Blob`].
    pub(super) fn check(&mut self, bucket: &Bucket) -> Result<(), FleetError> {
        if self.looked.is_some_and(|looked| looked.elapsed() < BEAT.min(self.patience)) {
            return Ok(());
        }
        let sign = bucket.get(&self.run.pulse_key())?.map(|bytes| bytes.to_vec());
        let now = Instant::now();
        // What happened while this worker was busy, or stood still, is no silence.
        if sign != self.last || self.looked.is_none() {
            (self.last, self.since) = (sign, now);
        }
        self.looked = Some(now);
        let silence = now.duration_since(self.since);
        if silence < self.patience {
            return Ok(());
        }
        let (run, url) = (self.run.0, bucket.url().to_owned());
        Err(FleetError::Abandoned { run, secs: silence.as_secs(), url })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A worker that has waited is content with a sign that is new, and gives up at the same one.
    #[test]
    fn silence_is_noticed() {
        let dir = tempfile::tempdir().expect("a folder");
        let bucket = Arc::new(Bucket::open(dir.path().to_str().expect("UTF-8"), []).expect("opens"));
        let run = Run(3);
        let patience = Duration::from_millis(30);
        let mut pulse = Pulse::new(run, patience);
        let heart = Heart::start(&bucket, run);
        while bucket.get(&run.pulse_key()).expect("reads").is_none() {
            std::thread::sleep(Duration::from_millis(1));
        }
        drop(heart);
        pulse.check(&bucket).expect("first look");
        std::thread::sleep(2 * patience);
        bucket.put(&run.pulse_key(), "another").expect("puts");
        pulse.check(&bucket).expect("a new sign");
        std::thread::sleep(2 * patience);
        let error = pulse.check(&bucket).expect_err("the same sign").to_string();
        assert!(error.contains("run 3") && error.contains("start the same encode again"), "{error}");
    }
}
