//! The HTTP service that robots fetch from.
//!
//! | resource | answer |
//! |---|---|
//! | `GET /v1/manifest` | signed manifest, strong `ETag` |
//! | `GET /v1/objects/{hash}` | a shard that the current manifest or the one before it lists; single ranges |
//! | `GET /v1/cells?x=&y=&z=&radius=` | cells near a point of the world frame |
//! | `GET /v1/cells?lat=&lon=[&height=]&radius=` | cells near a place on the earth |
//! | `GET /v1/coverage.geojson` | footprints of the cells |
//! | `GET /healthz` | alive, and which generation is served |
//!
//! It needs no lock on the store and notices a new manifest by one `stat` a request.

mod connection;
mod problem;
mod range;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::error_handling::HandleErrorLayer;
use axum::extract::rejection::{PathRejection, QueryRejection};
use axum::extract::{Path as UrlPath, Query, State};
use axum::http::{HeaderMap, HeaderName, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{BoxError, Json, Router, middleware};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::frames::Aabb;
use slag_common::manifest::{CellIndex, Manifest, ShardRecord};
use slag_common::shard::Profile;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncSeekExt, ReadBuf};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::io::ReaderStream;
use tower::ServiceBuilder;
use tower::limit::GlobalConcurrencyLimitLayer;
use tower::load_shed::LoadShedLayer;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::limit::RequestBodyLimitLayer;
use tower_http::timeout::TimeoutLayer;

use super::geographic;
use crate::store::{StoreError, StoreReader};
use problem::ApiError;
use range::Selection;

/// Pieces in which objects are read and sent.
const PIECE_BYTES: usize = 64 << 10;
/// No request here has a body; a few bytes of a careless client do no harm.
const REQUEST_BODY_BYTES: usize = 1024;

/// Bounds of the service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Connections open at once; further ones wait.
    pub n_connections: usize,
    /// Requests being answered at once; further ones get 503.
    pub n_requests: usize,
    /// Objects being sent at once; further ones get 503.
    pub n_downloads: usize,
    /// Time until an answer must begin, else 503.
    pub answer_timeout: Duration,
    /// Time without a byte sent after which a connection is dropped.
    pub stall_timeout: Duration,
    /// Time that answers under way have after a stop was asked for.
    pub drain_timeout: Duration,
}

impl Default for Limits {
    /// Bounds for a machine with a few cores: 64 downloads in pieces take 4 MiB.
    fn default() -> Self {
        Self {
            n_connections: 1024,
            n_requests: 128,
            n_downloads: 64,
            answer_timeout: Duration::from_secs(10),
            stall_timeout: Duration::from_secs(30),
            drain_timeout: Duration::from_secs(10),
        }
    }
}

/// Why the service does not start or ends.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The store cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The address cannot be listened on.
    #[error("cannot listen on {address}: {cause}; choose another address or port")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Why.
        cause: io::Error,
    },
    /// Accepting connections failed for good.
    #[error("the service ended: {0}; start it again")]
    Ended(io::Error),
}

/// Serves a store until `shutdown` completes, then lets answers under way finish for a while.
///
/// `on_listening` gets the address listened on: its port is the system's choice if `listen` has port 0.
///
/// # Errors
/// [`ServeError`]; a store without a published scene is one.
pub async fn serve(
    dir: &Path,
    listen: SocketAddr,
    limits: Limits,
    on_listening: impl FnOnce(SocketAddr),
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<(), ServeError> {
    let router = router(dir, limits)?;
    let refused = |cause| ServeError::Listen { address: listen, cause };
    let tcp = tokio::net::TcpListener::bind(listen).await.map_err(refused)?;
    on_listening(tcp.local_addr().map_err(refused)?);
    let slots = Arc::new(Semaphore::new(limits.n_connections));
    let listener = connection::BoundedListener { tcp, slots, stall_timeout: limits.stall_timeout };
    let (stopping, stopped) = tokio::sync::oneshot::channel();
    let server = axum::serve(listener, router).with_graceful_shutdown(async move {
        shutdown.await;
        // Fails only if the service has ended already.
        let _ = stopping.send(());
    });
    let overdue = async move {
        match stopped.await {
            Ok(()) => tokio::time::sleep(limits.drain_timeout).await,
            Err(_) => std::future::pending().await,
        }
    };
    tokio::select! {
        ended = server.into_future() => ended.map_err(ServeError::Ended),
        () = overdue => {
            tracing::warn!("answers still under way after {:?} are given up", limits.drain_timeout);
            Ok(())
        }
    }
}

/// Completes at ctrl-c or, on Unix, SIGTERM.
///
/// # Errors
/// What the system says if signals cannot be listened for.
pub async fn stop_signal() -> io::Result<()> {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        let mut terminate = signal(SignalKind::terminate())?;
        tokio::select! {
            pressed = tokio::signal::ctrl_c() => pressed,
            _ = terminate.recv() => Ok(()),
        }
    }
    #[cfg(not(unix))]
    tokio::signal::ctrl_c().await
}

/// Returns the service of a store, without a listener.
///
/// # Errors
/// [`StoreError`] if nothing is published or it cannot be read.
pub fn router(dir: &Path, limits: Limits) -> Result<Router, StoreError> {
    let service = Service {
        snapshot: RwLock::new(Arc::new(Snapshot::open(dir)?)),
        reloading: Mutex::new(()),
        dir: dir.to_owned(),
        downloads: Arc::new(Semaphore::new(limits.n_downloads)),
    };
    let routes = Router::new()
        .route("/v1/manifest", get(manifest))
        .route("/v1/objects/{hash}", get(object))
        .route("/v1/cells", get(cells))
        .route("/v1/coverage.geojson", get(coverage))
        .route("/healthz", get(health))
        .with_state(Arc::new(service));
    Ok(bounded(routes, limits))
}

/// Puts the limits around routes, and a problem body on whatever goes wrong in them.
fn bounded(routes: Router, limits: Limits) -> Router {
    let timeout = TimeoutLayer::with_status_code(StatusCode::SERVICE_UNAVAILABLE, limits.answer_timeout);
    let shed = ServiceBuilder::new()
        .layer(HandleErrorLayer::new(|_: BoxError| std::future::ready(ApiError::Busy)))
        .layer(LoadShedLayer::new())
        // One count for all routes; the plain layer would give each route its own.
        .layer(GlobalConcurrencyLimitLayer::new(limits.n_requests))
        .layer(RequestBodyLimitLayer::new(REQUEST_BODY_BYTES))
        .layer(timeout);
    let n_requests = Arc::new(AtomicU64::new(1));
    routes
        .layer(shed)
        .layer(CatchPanicLayer::custom(panicked))
        .layer(middleware::from_fn_with_state(n_requests, problem::render))
}

fn panicked(panic: Box<dyn std::any::Any + Send>) -> Response {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let text = text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
    ApiError::Internal(format!("a handler panicked: {text}")).into_response()
}

/// One generation, as it is served.
struct Snapshot {
    reader: StoreReader,
    manifest: Bytes,
    index: CellIndex,
    /// Lengths of the shards that may be fetched.
    objects: BTreeMap<Hash32, u64>,
}

impl Snapshot {
    fn open(dir: &Path) -> Result<Self, StoreError> {
        let reader = StoreReader::open(dir)?;
        let both = [reader.previous(), Some(reader.current())].into_iter().flatten();
        Ok(Self {
            manifest: reader.current().signed.clone().into(),
            index: CellIndex::new(&reader.manifest().cells),
            objects: both.flat_map(|published| published.shard_lens()).collect(),
            reader,
        })
    }

    fn world(&self) -> &Manifest {
        self.reader.manifest()
    }
}

struct Service {
    snapshot: RwLock<Arc<Snapshot>>,
    reloading: Mutex<()>,
    dir: PathBuf,
    downloads: Arc<Semaphore>,
}

type AppState = State<Arc<Service>>;

impl Service {
    fn snapshot(&self) -> Arc<Snapshot> {
        Arc::clone(&self.snapshot.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Returns what is published now; blocks on a `stat`, and on reading where it changed.
    fn current(&self) -> Arc<Snapshot> {
        let snapshot = self.snapshot();
        if snapshot.reader.is_current() {
            return snapshot;
        }
        let _one_at_a_time = self.reloading.lock().unwrap_or_else(PoisonError::into_inner);
        let snapshot = self.snapshot();
        if snapshot.reader.is_current() {
            return snapshot;
        }
        match Snapshot::open(&self.dir) {
            Ok(fresh) => {
                let fresh = Arc::new(fresh);
                *self.snapshot.write().unwrap_or_else(PoisonError::into_inner) = Arc::clone(&fresh);
                fresh
            }
            Err(e) => {
                let generation = snapshot.world().generation;
                tracing::warn!("the new manifest cannot be read, generation {generation} stays served: {e}");
                snapshot
            }
        }
    }

    /// Runs file access and search beside the asynchronous threads, on what is published now.
    async fn with_current<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Snapshot) -> Result<T, ApiError> + Send + 'static,
    ) -> Result<T, ApiError> {
        let service = Arc::clone(self);
        let done = tokio::task::spawn_blocking(move || work(&service.current()));
        done.await.map_err(|e| ApiError::Internal(e.to_string()))?
    }
}

fn tag_of(hash: Hash32) -> String {
    format!("\"{hash}\"")
}

/// Returns whether the client says that it has this already.
fn client_has(headers: &HeaderMap, tag: &str) -> bool {
    let values = headers.get_all(header::IF_NONE_MATCH);
    values.iter().filter_map(|value| value.to_str().ok()).any(|value| range::names_tag(value, tag))
}

async fn manifest(State(service): AppState, headers: HeaderMap) -> Result<Response, ApiError> {
    let published = |snapshot: &Snapshot| Ok((snapshot.reader.current().hash, snapshot.manifest.clone()));
    let (hash, signed) = service.with_current(published).await?;
    let tag = tag_of(hash);
    let not_modified = client_has(&headers, &tag);
    let about = [(header::ETAG, tag), (header::CACHE_CONTROL, "no-cache".to_owned())];
    if not_modified {
        return Ok((StatusCode::NOT_MODIFIED, about).into_response());
    }
    Ok((about, [(header::CONTENT_TYPE, "application/octet-stream")], signed).into_response())
}

async fn object(
    State(service): AppState,
    method: Method,
    hash: Result<UrlPath<Hash32>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let UrlPath(hash) = hash.map_err(|e| ApiError::Parameters(e.body_text()))?;
    let tag = tag_of(hash);
    let about = [
        (header::ETAG, tag.clone()),
        (header::CACHE_CONTROL, "public, max-age=31536000, immutable".to_owned()),
        (header::ACCEPT_RANGES, "bytes".to_owned()),
    ];
    let not_modified = client_has(&headers, &tag);
    let opened = service.with_current(move |snapshot| open_object(snapshot, hash, !not_modified)).await?;
    let Opened { file: Some(file), len_bytes } = opened else {
        return Ok((StatusCode::NOT_MODIFIED, about).into_response());
    };
    // A range is a matter of GET (14.2), and only of what the client has a part of (13.1.5).
    let asked = match (headers.get(header::RANGE), headers.get(header::IF_RANGE)) {
        _ if method != Method::GET || headers.get_all(header::RANGE).iter().count() > 1 => None,
        (Some(range), Some(condition)) if condition.as_bytes() == tag.as_bytes() => range.to_str().ok(),
        (Some(range), None) => range.to_str().ok(),
        _ => None,
    };
    let (status, start, n_bytes) = match asked.map_or(Selection::Whole, |text| range::select(text, len_bytes))
    {
        Selection::Unsatisfiable => return Err(ApiError::Range { len_bytes }),
        Selection::Whole => (StatusCode::OK, 0, len_bytes),
        Selection::Part(part) => (StatusCode::PARTIAL_CONTENT, *part.start(), part.end() - part.start() + 1),
    };
    let mut sizes: Vec<(HeaderName, String)> = vec![(header::CONTENT_LENGTH, n_bytes.to_string())];
    if status == StatusCode::PARTIAL_CONTENT {
        let end = start + n_bytes - 1;
        sizes.push((header::CONTENT_RANGE, format!("bytes {start}-{end}/{len_bytes}")));
    }
    let body = if method == Method::HEAD {
        Body::empty()
    } else {
        let slot = Arc::clone(&service.downloads).try_acquire_owned().map_err(|_| ApiError::Busy)?;
        let mut file = tokio::fs::File::from_std(file);
        file.seek(io::SeekFrom::Start(start))
            .await
            .map_err(|e| ApiError::Internal(format!("{hash}: {e}")))?;
        Body::from_stream(ReaderStream::with_capacity(
            Download { file: file.take(n_bytes), _slot: slot },
            PIECE_BYTES,
        ))
    };
    let mut response =
        (status, about, [(header::CONTENT_TYPE, "application/octet-stream")], body).into_response();
    for (name, value) in sizes {
        let value = value.parse().map_err(|_| ApiError::Internal(format!("header {name}: {value}")))?;
        response.headers_mut().insert(name, value);
    }
    Ok(response)
}

/// A listed object: its length, and its file where the content is wanted.
struct Opened {
    file: Option<std::fs::File>,
    len_bytes: u64,
}

fn open_object(snapshot: &Snapshot, hash: Hash32, with_file: bool) -> Result<Opened, ApiError> {
    let len_bytes =
        *snapshot.objects.get(&hash).ok_or_else(|| ApiError::NotFound(format!("object {hash}")))?;
    if !with_file {
        return Ok(Opened { file: None, len_bytes });
    }
    let internal = |e: io::Error| ApiError::Internal(e.to_string());
    let file = fs_err::File::open(snapshot.reader.object_path(hash)).map_err(internal)?;
    let found_bytes = file.metadata().map_err(internal)?.len();
    if found_bytes != len_bytes {
        let path = file.path().display();
        return Err(ApiError::Internal(format!("{path}: {found_bytes} bytes, {len_bytes} are listed")));
    }
    Ok(Opened { file: Some(file.into_file()), len_bytes })
}

/// A file on its way out; holds its slot until it is sent or the client is gone.
struct Download {
    file: tokio::io::Take<tokio::fs::File>,
    _slot: OwnedSemaphorePermit,
}

impl AsyncRead for Download {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.file).poll_read(context, buffer)
    }
}

/// A centre, in one of two frames, and a radius.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct CellsQuery {
    x: Option<f64>,
    y: Option<f64>,
    z: Option<f64>,
    lat: Option<f64>,
    lon: Option<f64>,
    height: Option<f64>,
    radius: Option<f64>,
}

impl CellsQuery {
    /// Returns centre and radius in the world frame.
    fn ball_in_world(self, manifest: &Manifest) -> Result<(DVec3, f64), ApiError> {
        let wrong = |what: &str| Err(ApiError::Parameters(what.to_owned()));
        let radius = match self.radius {
            Some(radius) if radius >= 0.0 && radius.is_finite() => radius,
            _ => return wrong("radius must be given, finite and not negative, in units of the world frame"),
        };
        let centre = match self {
            Self { x: Some(x), y: Some(y), z: Some(z), lat: None, lon: None, height: None, .. } => {
                DVec3::new(x, y, z)
            }
            Self { x: None, y: None, z: None, lat: Some(lat), lon: Some(lon), height, .. } => {
                geographic::world_from_geographic(manifest, lat, lon, height)
                    .map_err(|e| ApiError::Parameters(e.to_string()))?
            }
            _ => return wrong("the centre must be given as x, y and z, or as lat and lon (and height)"),
        };
        if !centre.is_finite() {
            return wrong("the centre must be finite");
        }
        Ok((centre, radius))
    }
}

#[derive(Serialize)]
struct CellsAnswer {
    generation: u64,
    encoder_id: Hash32,
    cells: Vec<CellAnswer>,
}

#[derive(Serialize)]
struct CellAnswer {
    cell_id: u32,
    bounds: Aabb,
    n_gaussians: u32,
    /// From the centre to the box, world units; 0 inside.
    distance: f64,
    shards: BTreeMap<Profile, ShardRecord>,
}

async fn cells(
    State(service): AppState,
    query: Result<Query<CellsQuery>, QueryRejection>,
) -> Result<Json<CellsAnswer>, ApiError> {
    let Query(query) = query.map_err(|e| ApiError::Parameters(e.body_text()))?;
    let search = move |snapshot: &Snapshot| {
        let manifest = snapshot.world();
        let (centre, radius) = query.ball_in_world(manifest)?;
        let near = snapshot.index.within(centre, radius).into_iter().map(|i| &manifest.cells[i]);
        let cells = near.map(|cell| CellAnswer {
            cell_id: cell.cell_id,
            bounds: cell.bounds,
            n_gaussians: cell.n_gaussians,
            distance: cell.bounds.distance_to(centre),
            shards: cell.shards.clone(),
        });
        let cells = cells.collect();
        Ok(CellsAnswer { generation: manifest.generation, encoder_id: manifest.encoder.id, cells })
    };
    service.with_current(search).await.map(Json)
}

async fn coverage(State(service): AppState) -> Result<Response, ApiError> {
    let draw = |snapshot: &Snapshot| {
        let drawn = geographic::coverage(snapshot.world()).map_err(ApiError::NotGeoReferenced)?;
        Ok(drawn.to_string())
    };
    let text = service.with_current(draw).await?;
    Ok(([(header::CONTENT_TYPE, "application/geo+json")], text).into_response())
}

async fn health(State(service): AppState) -> Result<Response, ApiError> {
    let generation = service.with_current(|snapshot| Ok(snapshot.world().generation)).await?;
    Ok(Json(serde_json::json!({ "status": "ok", "generation": generation })).into_response())
}
