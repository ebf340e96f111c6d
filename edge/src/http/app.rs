//! The service's state.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use glam::DVec3;
use slag_common::Hash32;
use slag_common::manifest::Manifest;
use slag_service::access::Access;
use slag_service::listener::ConnectionLimits;
use slag_service::metrics::{Exposition, Histogram, ResponseCounts};
use slag_service::problem::Problem;
use tokio::sync::{Semaphore, watch};

use super::problem::{out_of_time, overloaded, timeout};
use crate::fetch::follow::{FollowStatus, Following};
use crate::query::Engine;
use crate::score::{Budget, OverBudget, Pool};
use crate::store::Snapshot;

pub struct App {
    pub(super) engine: Engine,
    pub(super) settings: Settings,
    pub(super) permits: Arc<Semaphore>,
    query_memory: Arc<Pool>,
    pub(super) metrics: Metrics,
    pub(super) following: Option<Arc<Following>>,
    pub(super) listeners: Arc<Semaphore>,
    /// Whether the service stops; ends streams that would never end.
    pub(super) stopping: watch::Sender<bool>,
    loading: Mutex<()>,
    /// Unreadable shards already handed to the follower.
    asked: Mutex<BTreeSet<Hash32>>,
}

impl App {
    /// Serves an engine's generation and those of later fetches.
    pub fn new(engine: Engine, settings: Settings) -> Arc<Self> {
        Self::following(engine, settings, None)
    }

    /// As [`App::new`]; hands the positions of `POST /position` to `following`.
    pub fn following(engine: Engine, settings: Settings, following: Option<Arc<Following>>) -> Arc<Self> {
        let app = Self {
            engine,
            permits: Arc::new(Semaphore::new(settings.max_queries)),
            query_memory: Pool::new(settings.all_queries_bytes),
            listeners: Arc::new(Semaphore::new(settings.max_listeners)),
            stopping: watch::Sender::new(false),
            settings,
            metrics: Metrics::default(),
            following,
            loading: Mutex::default(),
            asked: Mutex::default(),
        };
        app.ask_for_unreadable();
        Arc::new(app)
    }

    /// Returns the robot's last position, if it is followed and the scene can place it.
    pub(super) fn last_position(&self, manifest: &Manifest) -> Option<DVec3> {
        self.following.as_ref()?.status().position?.in_world(manifest).ok()
    }

    /// Loads another generation if the cache changed (one `stat` call): in the background while one on board answers,
    /// else blocking.
    pub(super) fn reload_if_stale(self: &Arc<Self>) {
        if !self.engine.is_stale() {
            return;
        }
        if self.engine.snapshot().is_err() {
            let _loading = self.loading.lock().unwrap_or_else(PoisonError::into_inner);
            // Another thread may have loaded it meanwhile.
            if self.engine.is_stale() {
                self.reload();
            }
            return;
        }
        // Another thread loads already.
        if self.loading.try_lock().is_err() {
            return;
        }
        let app = Arc::clone(self);
        tokio::task::spawn_blocking(move || {
            if let Ok(_loading) = app.loading.try_lock() {
                app.reload();
            }
        });
    }

    /// Loads the latest fetch's generation, after a load in progress. Blocks; queries do not wait.
    pub fn reload_now(&self) {
        let _loading = self.loading.lock().unwrap_or_else(PoisonError::into_inner);
        self.reload();
    }

    fn reload(&self) {
        let counter = match self.engine.reload() {
            Ok(()) => {
                self.ask_for_unreadable();
                &self.metrics.reloads
            }
            Err(error) => {
                tracing::warn!("the newest generation does not open: {}", crate::error_line(&error));
                &self.metrics.reload_failures
            }
        };
        counter.fetch_add(1, Ordering::Relaxed);
    }

    /// Asks the follower to fetch shards that do not open, once each.
    fn ask_for_unreadable(&self) {
        let (Some(following), Ok(snapshot)) = (&self.following, self.engine.snapshot()) else { return };
        let unreadable: BTreeSet<Hash32> = snapshot.unreadable().collect();
        let mut asked = self.asked.lock().unwrap_or_else(PoisonError::into_inner);
        if !unreadable.is_subset(&asked) {
            following.refresh();
        }
        *asked = unreadable;
    }

    /// Runs blocking or computing work off the async threads.
    pub(super) async fn blocking<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Arc<Self>) -> Result<T, Problem> + Send + 'static,
    ) -> Result<T, Problem> {
        let app = Arc::clone(self);
        tokio::task::spawn_blocking(move || work(&app)).await.unwrap_or_else(|e| Err(Problem::internal(e)))
    }

    /// Runs work within the limits of a query, on the newest generation: holds one query permit until the work ends,
    /// with a budget of memory and time. `time`: the client's own limit.
    pub(super) async fn within_limits<T: Send + 'static>(
        self: &Arc<Self>,
        time: Option<Duration>,
        work: impl FnOnce(&Arc<Self>, &Budget) -> Result<T, Problem> + Send + 'static,
    ) -> Result<T, Problem> {
        let permit = Arc::clone(&self.permits).try_acquire_owned();
        let permit = permit.map_err(|_| overloaded(self.settings.max_queries))?;
        let given = time.filter(|time| *time < self.settings.query_timeout);
        let limit = given.unwrap_or(self.settings.query_timeout);
        let budget = Budget::new(self.settings.query_bytes, limit, &self.query_memory);
        let working = self.blocking(move |app| {
            // Held until the work is done, even if the client has given up.
            let _permit = permit;
            app.reload_if_stale();
            let done = work(app, &budget);
            match (given, budget.check()) {
                (Some(given), Err(OverBudget::Time { .. })) => Err(out_of_time(given)),
                _ => done,
            }
        });
        let late = |_| given.map_or_else(|| timeout(limit), out_of_time);
        tokio::time::timeout(limit + TO_SAY_SO, working).await.map_err(late)?
    }
}

/// Grace for work over its budget to answer with a suggestion.
const TO_SAY_SO: Duration = Duration::from_millis(100);

/// Time for a request and for sending its answer, besides the query's.
const STALL_BEYOND_QUERY: Duration = Duration::from_secs(50);

#[derive(Clone, Debug)]
pub struct Settings {
    pub connections: ConnectionLimits,
    pub access: Access,
    /// Concurrent queries; further ones get 503.
    pub max_queries: usize,
    /// Clients of `GET /v1/events`; further ones get 503.
    pub max_listeners: usize,
    /// Time until an answer must begin, else 503; also the query's computing time.
    pub query_timeout: Duration,
    /// Memory of a query; one that needs more gets 422.
    pub query_bytes: u64,
    /// Memory of all queries in progress; one that exceeds it gets 503.
    pub all_queries_bytes: u64,
    pub stream_timeout: Duration,
}

impl Settings {
    /// Returns limits for a machine with a few cores. All queries together may use four times the memory of one.
    pub(crate) fn with_budget(query_bytes: u64, query_timeout: Duration) -> Self {
        let connections = ConnectionLimits {
            n_connections: 512,
            n_per_peer: 384,
            stall_timeout: query_timeout + STALL_BEYOND_QUERY,
            drain_timeout: Duration::from_secs(5),
            ..ConnectionLimits::default()
        };
        Self {
            connections,
            access: Access::default(),
            max_queries: 32,
            max_listeners: 32,
            query_timeout,
            query_bytes,
            all_queries_bytes: query_bytes.saturating_mul(4),
            stream_timeout: Duration::from_secs(60),
        }
    }
}

impl Default for Settings {
    fn default() -> Self {
        Self::with_budget(256 << 20, Duration::from_secs(10))
    }
}

/// Upper bounds of the buckets of query times, seconds: from a cached text over few centroids to a timeout.
const QUERY_BOUNDS_SECS: [f64; 11] =
    [0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128, 0.512, 2.048];

pub struct Metrics {
    pub responses: Arc<ResponseCounts>,
    /// Times of queries, including refused ones.
    pub query_times: Histogram,
    pub empty_answers: AtomicU64,
    pub reloads: AtomicU64,
    pub reload_failures: AtomicU64,
}

impl Default for Metrics {
    fn default() -> Self {
        Self {
            responses: Arc::default(),
            query_times: Histogram::new(&QUERY_BOUNDS_SECS),
            empty_answers: AtomicU64::new(0),
            reloads: AtomicU64::new(0),
            reload_failures: AtomicU64::new(0),
        }
    }
}

impl Metrics {
    pub fn render(
        &self,
        n_in_progress: usize,
        snapshot: Option<&Snapshot>,
        following: Option<&FollowStatus>,
    ) -> Exposition {
        let mut text = Exposition::new("slag_edge");
        text.responses(&self.responses);
        text.histogram(
            "query_duration_seconds",
            "Time from the request to the start of its answer.",
            &self.query_times,
        );
        text.gauge("queries_in_flight", "Queries in progress.", n_in_progress as u64);
        text.counter("empty_answers_total", "Questions that nothing matched.", &self.empty_answers);
        text.counter("reloads_total", "Generations put in place.", &self.reloads);
        text.counter("reload_failures_total", "Generations that did not open.", &self.reload_failures);
        if let Some(snapshot) = snapshot {
            text.gauge("generation", "Generation of the scene.", snapshot.manifest.generation);
            text.gauge("shards", "Shards on board.", snapshot.shards.len() as u64);
            let n_gaussians = snapshot.shards.iter().map(|shard| u64::from(shard.cell.n_gaussians)).sum();
            text.gauge("gaussians", "Gaussians on board.", n_gaussians);
        }
        if let Some(following) = following {
            let counts =
                [following.n_fetches, following.n_failures, following.n_restarts].map(AtomicU64::new);
            text.gauge(
                "follower_up",
                "Whether positions are followed.",
                u64::from(following.failure.is_none()),
            );
            text.counter("follow_fetches_total", "Successful fetches of the follower.", &counts[0]);
            text.counter("follow_failures_total", "Failed fetches of the follower.", &counts[1]);
            text.counter(
                "follower_restarts_total",
                "Times that the follower failed and began again.",
                &counts[2],
            );
        }
        text
    }
}
