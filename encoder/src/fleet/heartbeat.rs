//! The coordinator's heartbeat: without it, workers would wait for ever for one that died for good.
//!
//! Workers compare what they read with what they read before, by their own clocks: those of the machines may
//! differ.

use std::sync::Arc;
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::time::{Duration, Instant};

use super::run::Run;
use crate::blobs::Bucket;
use crate::encode::EncodeError;

/// Interval of beats, and of checks for them.
const BEAT: Duration = Duration::from_secs(10);

pub(super) struct Heartbeat {
    _stop: Sender<()>,
}

impl Heartbeat {
    pub(super) fn start(bucket: &Arc<Bucket>, run: Run) -> Self {
        let (stop, stopped) = mpsc::channel();
        let bucket = Arc::clone(bucket);
        std::thread::spawn(move || {
            let mut n_beats = 0u64;
            while stopped.recv_timeout(if n_beats == 0 { Duration::ZERO } else { BEAT })
                == Err(RecvTimeoutError::Timeout)
            {
                n_beats += 1;
                if let Err(error) = bucket.put(&run.heartbeat_key(), n_beats.to_string()) {
                    tracing::warn!("no heartbeat: {error}");
                }
            }
        });
        Self { _stop: stop }
    }
}

pub(super) struct HeartbeatWatch {
    run: Run,
    /// The coordinator counts as gone after this long without a new beat.
    patience: Duration,
    /// The last beat, when it was first seen, and the last check.
    last: Option<Vec<u8>>,
    since: Instant,
    looked: Option<Instant>,
}

impl HeartbeatWatch {
    pub(super) fn new(run: Run, patience: Duration) -> Self {
        Self { run, patience, last: None, since: Instant::now(), looked: None }
    }

    /// Checks for a new beat, if it is time.
    ///
    /// # Errors
    /// [`EncodeError::Failed`] after too long a silence.
    pub(super) fn check(&mut self, bucket: &Bucket) -> Result<(), EncodeError> {
        if self.looked.is_some_and(|looked| looked.elapsed() < BEAT.min(self.patience)) {
            return Ok(());
        }
        let beat = bucket.get(&self.run.heartbeat_key())?.map(|bytes| bytes.to_vec());
        let now = Instant::now();
        // Time in which this worker was busy or suspended is no silence.
        if beat != self.last || self.looked.is_none() {
            (self.last, self.since) = (beat, now);
        }
        self.looked = Some(now);
        let silence = now.duration_since(self.since);
        if silence < self.patience {
            return Ok(());
        }
        Err(EncodeError::Failed(format!(
            "run {}: its coordinator has shown no heartbeat for {} s. What is done lies in {}: start the same encode again, \
             then its workers",
            self.run.0,
            silence.as_secs(),
            bucket.url
        )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_test_support::assert_error;

    /// After a wait, a new beat is accepted; the same one is given up on.
    #[test]
    fn silence_is_noticed() {
        let dir = tempfile::tempdir().expect("a folder");
        let bucket = Arc::new(Bucket::open(dir.path().to_str().expect("UTF-8"), []).expect("opens"));
        let run = Run(3);
        let patience = Duration::from_millis(30);
        let mut watch = HeartbeatWatch::new(run, patience);
        let heartbeat = Heartbeat::start(&bucket, run);
        while bucket.get(&run.heartbeat_key()).expect("reads").is_none() {
            std::thread::sleep(Duration::from_millis(1));
        }
        drop(heartbeat);
        watch.check(&bucket).expect("first look");
        std::thread::sleep(2 * patience);
        bucket.put(&run.heartbeat_key(), "another").expect("puts");
        watch.check(&bucket).expect("a new beat");
        std::thread::sleep(2 * patience);
        assert_error(watch.check(&bucket), &["run 3", "start the same encode again"]);
    }
}
