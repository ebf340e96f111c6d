//! The robot's own HTTP service: questions, status, health and metrics.

mod metrics;
mod params;
mod position;
mod problem;
mod query;
mod serve;

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::{HeaderName, HeaderValue, Method, Uri, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use serde_json::json;
use tokio::sync::{Semaphore, watch};
use tower_http::catch_panic::CatchPanicLayer;

pub use problem::Problem;
pub use query::parse_query;
pub use serve::serve;

use crate::fetch::follow::Following;
use crate::query::{Engine, Status};
use metrics::Metrics;

const HELP: &str = "slag-edge answers where things are.

GET /query?text=chair   clusters of Gaussians that match, best first
    text=table          again: both are answered, in one pass
    negatives=canonical or a,b,c: scores are LERF's relevancy against these (default: none)
    limit=10            most answers to a text
    threshold=0.1       cosine or relevancy from which a Gaussian matches (default: the scene's)
    near=x,y,z          rank by distance too
    radius=r            only within r of near
    box=x,y,z,x,y,z     only between two corners
    kind=clusters       or gaussians
    voxel=v             edge of the voxels that join Gaussians to clusters
    min_count=n         smaller clusters are dropped
    precision=exact     centroids: by codebook centroids alone, fastest; measured: as far as measured errors decide
    format=json         or arrow: columns, of gaussians
GET /status             scene, generation, encoder, shards, and whether the scene is past its expiry
POST /position          where the robot is, if it is followed; JSON: x, y, z, or lat, lon, height
GET /healthz            the process lives
GET /readyz             a scene is loaded and fits the text model
GET /metrics            Prometheus
GET /openapi.json       all of this for programs
";

/// The description for programs; a test compares it with the routes, parameters and answers there are.
const OPENAPI: &str = include_str!("openapi.json");
const JSON: (HeaderName, HeaderValue) = (header::CONTENT_TYPE, HeaderValue::from_static("application/json"));

/// The paths there are.
const ROUTES: [&str; 8] =
    ["/", "/query", "/status", "/position", "/healthz", "/readyz", "/metrics", "/openapi.json"];

/// What the service may use.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Queries at a time; more are turned away.
    pub max_queries: usize,
    /// Connections at a time; more wait to be accepted.
    pub max_connections: usize,
    /// An answer takes no longer.
    pub query_timeout: Duration,
    /// Sending a long answer takes no longer.
    pub stream_timeout: Duration,
    /// A request's head takes no longer to arrive; a connection idles no longer.
    pub header_timeout: Duration,
    /// After a stop signal, requests under way have so long.
    pub drain: Duration,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            max_queries: 32,
            max_connections: 512,
            query_timeout: Duration::from_secs(10),
            stream_timeout: Duration::from_secs(60),
            header_timeout: Duration::from_secs(30),
            drain: Duration::from_secs(5),
        }
    }
}

/// The service's state.
pub struct App {
    engine: Engine,
    settings: Settings,
    permits: Arc<Semaphore>,
    metrics: Metrics,
    is_reloading: AtomicBool,
    n_reload_attempts: watch::Sender<u64>,
    n_requests: AtomicU64,
    following: Option<Arc<Following>>,
}

impl App {
    /// Wraps an engine; what it has loaded is served, and what is fetched later replaces it.
    pub fn new(engine: Engine, settings: Settings) -> Arc<Self> {
        Self::following(engine, settings, None)
    }

    /// As [`App::new`], and `POST /position` is handed on.
    pub fn following(engine: Engine, settings: Settings, following: Option<Arc<Following>>) -> Arc<Self> {
        Arc::new(Self {
            engine,
            permits: Arc::new(Semaphore::new(settings.max_queries)),
            settings,
            metrics: Metrics::default(),
            is_reloading: AtomicBool::new(false),
            n_reload_attempts: watch::Sender::new(0),
            n_requests: AtomicU64::new(0),
            following,
        })
    }

    /// Returns a counter of finished attempts to load another generation.
    pub fn reload_attempts(&self) -> watch::Receiver<u64> {
        self.n_reload_attempts.subscribe()
    }

    /// Starts loading in the background if the cache changed and nobody does yet. One `stat` call.
    fn reload_if_stale(self: &Arc<Self>) {
        if !self.engine.is_stale() || self.is_reloading.swap(true, Ordering::AcqRel) {
            return;
        }
        let app = Arc::clone(self);
        tokio::task::spawn_blocking(move || app.reload());
    }

    /// Loads what a fetch has just brought, unless someone does already. Blocks; questions do not wait.
    pub fn reload_now(&self) {
        if !self.is_reloading.swap(true, Ordering::AcqRel) {
            self.reload();
        }
    }

    fn reload(&self) {
        let counter = match self.engine.reload() {
            Ok(()) => &self.metrics.reloads,
            Err(error) => {
                tracing::warn!("the newest generation does not open: {}", crate::error_line(&error));
                &self.metrics.reload_failures
            }
        };
        counter.fetch_add(1, Ordering::Relaxed);
        self.is_reloading.store(false, Ordering::Release);
        self.n_reload_attempts.send_modify(|n| *n += 1);
    }
}

/// Returns the service's routes.
pub fn router(app: Arc<App>) -> Router {
    Router::new()
        .route("/", get(|| async { HELP }))
        .route("/query", get(query::query))
        .route("/openapi.json", get(|| async { ([JSON], OPENAPI) }))
        .route("/status", get(status))
        .route("/position", post(position::position).layer(DefaultBodyLimit::max(position::MAX_BODY_BYTES)))
        .route("/healthz", get(|| async { "alive\n" }))
        .route("/readyz", get(ready))
        .route("/metrics", get(metrics))
        .fallback(|uri: Uri| async move { Problem::not_found(uri.path()) })
        .method_not_allowed_fallback(
            |method: Method| async move { Problem::method_not_allowed(method.as_str()) },
        )
        .layer(CatchPanicLayer::custom(|panic: Box<dyn Any + Send>| {
            Problem::internal(&panic_text(&*panic)).into_response()
        }))
        .layer(from_fn_with_state(Arc::clone(&app), observe))
        .with_state(app)
}

fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied().or(panic.downcast_ref::<String>().map(String::as_str));
    format!("panic: {}", text.unwrap_or("of an unknown kind"))
}

/// Gives each request an id, logs it, and counts its response.
async fn observe(State(app): State<Arc<App>>, request: Request, next: Next) -> Response {
    let started = Instant::now();
    let id = app.n_requests.fetch_add(1, Ordering::Relaxed) + 1;
    // Only our own paths become labels: a scanner must not fill the metrics.
    let route = ROUTES.into_iter().find(|route| *route == request.uri().path()).unwrap_or("other");
    let mut response = next.run(request).await;
    let status = response.status().as_u16();
    app.metrics.count_response(route, status);
    if route == "/query" {
        app.metrics.observe_query(started.elapsed());
    }
    tracing::debug!(id, route, status, took = ?started.elapsed(), "request");
    response.headers_mut().insert("x-request-id", HeaderValue::from(id));
    response
}

/// Runs what blocks or computes off the async threads.
async fn blocking<T: Send + 'static>(
    app: &Arc<App>,
    work: impl FnOnce(&Arc<App>) -> Result<T, Problem> + Send + 'static,
) -> Result<T, Problem> {
    let app = Arc::clone(app);
    tokio::task::spawn_blocking(move || work(&app)).await.unwrap_or_else(|e| Err(Problem::internal(&e)))
}

async fn ready(State(app): State<Arc<App>>) -> Result<&'static str, Problem> {
    blocking(&app, |app| {
        app.reload_if_stale();
        let snapshot = app.engine.snapshot()?;
        app.engine.check_encoder(&snapshot)?;
        if app.engine.text_is_alive() {
            Ok("ready\n")
        } else {
            Err(Problem::internal(&"the text model has stopped"))
        }
    })
    .await
}

async fn status(State(app): State<Arc<App>>) -> Result<Response, Problem> {
    blocking(&app, |app| {
        app.reload_if_stale();
        let snapshot = app.engine.snapshot();
        let error = snapshot.as_ref().map_or_else(
            |e| Some(e.to_string()),
            |snapshot| app.engine.check_encoder(snapshot).err().map(|e| e.to_string()),
        );
        let manifest = snapshot.as_ref().ok().map(|snapshot| &snapshot.manifest);
        let expires_unix_secs = manifest.and_then(|manifest| manifest.expires_unix_secs);
        // It goes on answering: an old map is better than none, as long as this is said.
        let is_expired = manifest.is_some_and(|m| m.check_expiry(crate::now_unix_secs()).is_err());
        let following = app.following.as_ref().map(|following| following.status());
        let scene = snapshot.as_ref().ok().map(|snapshot| Status::of(snapshot));
        let is_ready = error.is_none() && app.engine.text_is_alive();
        let version = env!("CARGO_PKG_VERSION");
        let text_model = app.engine.encoder();
        Ok(Json(json!({
            "version": version, "is_ready": is_ready, "error": error, "text_model": text_model, "scene": scene,
            "expires_unix_secs": expires_unix_secs, "is_expired": is_expired, "following": following,
        }))
        .into_response())
    })
    .await
}

async fn metrics(State(app): State<Arc<App>>) -> Response {
    let in_flight = app.settings.max_queries - app.permits.available_permits();
    let text = app.metrics.render(in_flight, app.engine.snapshot().ok().as_deref());
    ([(header::CONTENT_TYPE, HeaderValue::from_static("text/plain; version=0.0.4"))], text).into_response()
}

#[cfg(test)]
mod tests;
