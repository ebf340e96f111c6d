//! The generation that is served, and its replacement.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use axum::extract::State;
use slag_common::Hash32;
use slag_common::manifest::{self, CellIndex, Manifest};
use slag_common::tuf::TargetFile;
use slag_service::listener::ConnectionLimits;
use slag_service::metrics::{Exposition, ResponseCounts};
use slag_service::problem::Problem;
use tokio::sync::Semaphore;

use crate::store::{Stamp, StoreError, StoreReader};

/// Pause before a manifest that failed to open is read again. The fault may lie in another file or pass by itself (no
/// file descriptors left), so the manifest need not change.
const RETRY_PAUSE: Duration = Duration::from_secs(10);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    pub connections: ConnectionLimits,
    /// Concurrent requests; more get 503.
    pub(crate) n_requests: usize,
    /// Objects sent concurrently; more get 503.
    pub(crate) n_downloads: usize,
    /// Time until an answer must begin, else 503.
    pub(crate) answer_timeout: Duration,
}

impl Default for Limits {
    /// For a machine with a few cores: 64 downloads in pieces take 4 MiB.
    fn default() -> Self {
        Self {
            connections: ConnectionLimits::default(),
            n_requests: 128,
            n_downloads: 64,
            answer_timeout: Duration::from_secs(10),
        }
    }
}

pub(super) struct Snapshot {
    pub(super) reader: StoreReader,
    pub(super) manifest: Bytes,
    pub(super) index: CellIndex,
    /// Lengths of the shards of the current and the previous manifest.
    pub(super) objects: BTreeMap<Hash32, u64>,
    /// Current and previous manifest by their target names.
    pub(super) targets: BTreeMap<String, Bytes>,
}

impl Snapshot {
    fn open(dir: &Path) -> Result<Self, StoreError> {
        let reader = StoreReader::open(dir)?;
        let both = || [reader.previous(), Some(reader.current())].into_iter().flatten();
        let target = |bytes: &[u8]| {
            let name = TargetFile::of(bytes).file_name(manifest::TARGET).ok()?;
            Some((name, Bytes::copy_from_slice(bytes)))
        };
        Ok(Self {
            targets: both().filter_map(|published| target(&published.bytes)).collect(),
            manifest: reader.current().bytes.clone().into(),
            index: CellIndex::new(&reader.manifest().cells),
            objects: both().flat_map(|published| published.object_lens()).collect(),
            reader,
        })
    }

    pub(super) fn world(&self) -> &Manifest {
        self.reader.manifest()
    }
}

struct Failed {
    /// `None` if the file was missing.
    version: Option<Stamp>,
    at: Instant,
}

pub(super) struct Service {
    dir: PathBuf,
    snapshot: RwLock<Arc<Snapshot>>,
    /// Last manifest that failed to open. Locked while a manifest is read, so that only one request reads it.
    failed: Mutex<Option<Failed>>,
    n_reloads: AtomicU64,
    n_reload_failures: AtomicU64,
    max_downloads: usize,
    pub(super) downloads: Arc<Semaphore>,
    pub(super) responses: Arc<ResponseCounts>,
}

pub(super) type AppState = State<Arc<Service>>;

impl Service {
    pub(super) fn open(dir: &Path, limits: &Limits) -> Result<Self, StoreError> {
        Ok(Self {
            snapshot: RwLock::new(Arc::new(Snapshot::open(dir)?)),
            dir: dir.to_owned(),
            failed: Mutex::new(None),
            n_reloads: AtomicU64::new(0),
            n_reload_failures: AtomicU64::new(0),
            max_downloads: limits.n_downloads,
            downloads: Arc::new(Semaphore::new(limits.n_downloads)),
            responses: Arc::default(),
        })
    }

    fn snapshot(&self) -> Arc<Snapshot> {
        Arc::clone(&self.snapshot.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Returns the published generation; blocks on a `stat`, and on reading a changed manifest. A manifest that fails
    /// to open leaves the current generation; it is logged once, and read again when it changes or after
    /// [`RETRY_PAUSE`].
    fn current(&self) -> Arc<Snapshot> {
        let snapshot = self.snapshot();
        if snapshot.reader.is_current() {
            return snapshot;
        }
        let mut failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
        // Another request may have read it meanwhile.
        let snapshot = self.snapshot();
        let version = Stamp::of_manifest(&self.dir);
        if version == Some(snapshot.reader.stamp()) {
            return snapshot;
        }
        let is_known_to_fail =
            |failed: &Failed| failed.version == version && failed.at.elapsed() < RETRY_PAUSE;
        if failed.as_ref().is_some_and(is_known_to_fail) {
            return snapshot;
        }
        match Snapshot::open(&self.dir) {
            Ok(fresh) => {
                let fresh = Arc::new(fresh);
                *self.snapshot.write().unwrap_or_else(PoisonError::into_inner) = Arc::clone(&fresh);
                *failed = None;
                self.n_reloads.fetch_add(1, Relaxed);
                fresh
            }
            Err(error) => {
                let is_new = failed.as_ref().is_none_or(|failed| failed.version != version);
                if is_new {
                    let generation = snapshot.world().generation;
                    tracing::warn!(
                        "the new manifest does not open, generation {generation} stays served: {error}"
                    );
                }
                *failed = Some(Failed { version, at: Instant::now() });
                self.n_reload_failures.fetch_add(1, Relaxed);
                snapshot
            }
        }
    }

    /// Runs blocking work on the published generation, off the asynchronous threads.
    pub(super) async fn with_current<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Snapshot) -> Result<T, Problem> + Send + 'static,
    ) -> Result<T, Problem> {
        let service = Arc::clone(self);
        let done = tokio::task::spawn_blocking(move || work(&service.current()));
        done.await.map_err(Problem::internal)?
    }
}

pub(super) async fn metrics(State(service): AppState) -> Result<Exposition, Problem> {
    let generation = service.with_current(|snapshot| Ok(snapshot.world().generation)).await?;
    let mut text = Exposition::new("slag_store");
    text.responses(&service.responses);
    let n_downloads = service.max_downloads.saturating_sub(service.downloads.available_permits());
    text.gauge("downloads_in_progress", "Objects being sent.", n_downloads as u64);
    text.gauge("generation", "Generation served.", generation);
    text.counter("reloads_total", "Generations put in place after the start.", &service.n_reloads);
    text.counter(
        "reload_failures_total",
        "Reads of a manifest that did not open.",
        &service.n_reload_failures,
    );
    Ok(text)
}
