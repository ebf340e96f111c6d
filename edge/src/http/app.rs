//! The service's state.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use glam::DVec3;
use slag_common::Hash32;
use slag_common::manifest::Manifest;
use slag_service::problem::Problem;
use tokio::sync::{Semaphore, watch};

use super::metrics::Metrics;
use super::settings::Settings;
use crate::fetch::follow::Following;
use crate::query::Engine;
use crate::score::{Budget, Pool};

/// The service's state.
pub struct App {
    pub(super) engine: Engine,
    pub(super) settings: Settings,
    /// A permit for each query in progress.
    pub(super) permits: Arc<Semaphore>,
    /// Memory of the queries in progress.
    query_memory: Arc<Pool>,
    pub(super) metrics: Metrics,
    pub(super) following: Option<Arc<Following>>,
    /// A permit for each client of `GET /v1/events`.
    pub(super) listeners: Arc<Semaphore>,
    /// Whether the service stops: what never ends by itself ends then.
    pub(super) stopping: watch::Sender<bool>,
    is_reloading: AtomicBool,
    /// Unreadable shards for which a fetch was asked.
    asked: Mutex<BTreeSet<Hash32>>,
    n_reload_attempts: watch::Sender<u64>,
}

impl App {
    /// Serves an engine's generation, and those that later fetches bring.
    pub fn new(engine: Engine, settings: Settings) -> Arc<Self> {
        Self::following(engine, settings, None)
    }

    /// Serves an engine as [`App::new`] does, and hands the positions of `POST /position` to `following`.
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
            is_reloading: AtomicBool::new(false),
            asked: Mutex::default(),
            n_reload_attempts: watch::Sender::new(0),
        };
        app.ask_for_unreadable();
        Arc::new(app)
    }

    /// Returns what a query that begins now may use.
    pub(super) fn query_budget(&self) -> Budget {
        self.query_budget_within(None)
    }

    /// Returns what a query that begins now may use, and less time if it asks for less.
    pub(super) fn query_budget_within(&self, time: Option<Duration>) -> Budget {
        let time = time.map_or(self.settings.query_timeout, |time| time.min(self.settings.query_timeout));
        Budget::new(self.settings.query_bytes, time, &self.query_memory)
    }

    /// Returns where the robot was last, if it is followed and the scene knows the place.
    pub(super) fn last_position(&self, manifest: &Manifest) -> Option<DVec3> {
        self.following.as_ref()?.status().position?.in_world(manifest).ok()
    }

    /// Returns a counter of finished attempts to load another generation.
    pub fn reload_attempts(&self) -> watch::Receiver<u64> {
        self.n_reload_attempts.subscribe()
    }

    /// Starts loading in the background if the cache changed and no load is in progress. One `stat` call.
    pub(super) fn reload_if_stale(self: &Arc<Self>) {
        if !self.engine.is_stale() || self.is_reloading.swap(true, Ordering::AcqRel) {
            return;
        }
        let app = Arc::clone(self);
        tokio::task::spawn_blocking(move || app.reload());
    }

    /// Loads the generation of the latest fetch, unless a load is in progress. Blocks; queries do not wait.
    pub fn reload_now(&self) {
        if !self.is_reloading.swap(true, Ordering::AcqRel) {
            self.reload();
        }
    }

    fn reload(&self) {
        /// Ends the attempt even if it panics: otherwise no later one would begin.
        struct Attempt<'a>(&'a App);
        impl Drop for Attempt<'_> {
            fn drop(&mut self) {
                if std::thread::panicking() {
                    self.0.metrics.reload_failures.fetch_add(1, Ordering::Relaxed);
                }
                self.0.is_reloading.store(false, Ordering::Release);
                self.0.n_reload_attempts.send_modify(|n| *n += 1);
            }
        }
        let _attempt = Attempt(self);
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

    /// Has the follower fetch shards that do not open, once each.
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
}
