//! `serve`, `query` and `status`.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::{Context, anyhow};
use slag_edge::http::{self, App, Settings};
use slag_edge::query::{Engine, QueryRequest, Status};
use slag_edge::store::{EdgeCache, Snapshot, StoreError};
use slag_edge::text::TextService;
use slag_models::{SessionOptions, find_runtime};
use tokio::net::TcpListener;

use super::output::{Failure, print_answers, print_json, print_status};
use super::{CacheArgs, ModelArgs, QueryArgs, ServeArgs, StatusArgs, ThreadArgs};

/// Async threads: they only pass requests on.
const ASYNC_THREADS: usize = 2;
/// Threads beside those of queries, for status and for loading a generation.
const SPARE_BLOCKING_THREADS: usize = 8;

impl CacheArgs {
    /// Returns the cache named, or the user's own.
    pub fn open(self) -> Result<EdgeCache, Failure> {
        let dir = self.cache.or_else(default_cache_dir);
        let advice = || Failure::Usage(anyhow!("neither XDG_CACHE_HOME nor HOME is set; give --cache DIR"));
        Ok(EdgeCache::open(dir.ok_or_else(advice)?))
    }
}

impl ThreadArgs {
    /// Bounds the threads that questions are worked on with; once in a process.
    pub fn apply(&self) -> Result<(), Failure> {
        let Some(n) = self.threads else { return Ok(()) };
        let built = rayon::ThreadPoolBuilder::new().num_threads(n.get()).build_global();
        built.map_err(|e| Failure::Failed("threads", e.into()))
    }
}

fn default_cache_dir() -> Option<PathBuf> {
    // The base directory specification has relative paths ignored.
    let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
    Some(base.join("slag"))
}

fn engine(cache: CacheArgs, models: &ModelArgs) -> Result<Engine, Failure> {
    let failed = Failure::of("models");
    let beside = std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.to_owned()));
    let beside: Vec<PathBuf> = beside.into_iter().collect();
    let runtime = find_runtime(models.runtime.as_deref(), &beside).map_err(|e| failed(e.into()))?;
    let options = SessionOptions::new(runtime);
    let text = TextService::open(models.models.as_deref(), &options).map_err(|e| failed(e.into()))?;
    Ok(Engine::new(cache.open()?, text))
}

/// Tells apart that nothing is on board yet.
pub fn store_failure(error: StoreError) -> Failure {
    let kind = if matches!(error, StoreError::Empty { .. }) { "no-scene" } else { "store" };
    Failure::Failed(kind, error.into())
}

pub fn query(args: QueryArgs) -> Result<(), Failure> {
    let request = QueryRequest {
        text: args.text,
        limit: args.limit,
        threshold: args.threshold,
        near: args.near,
        radius: args.radius,
        level: args.level,
        voxel: args.voxel,
        min_count: args.min_count,
    };
    request.check().map_err(|e| Failure::Usage(e.into()))?;
    args.threads.apply()?;
    let engine = engine(args.cache, &args.models)?;
    engine.reload().map_err(store_failure)?;
    let answers = engine.answer(&request)?;
    if args.json { print_json(&answers) } else { print_answers(&answers) }
}

pub fn status(args: StatusArgs) -> Result<(), Failure> {
    let snapshot = Snapshot::open(&args.cache.open()?).map_err(store_failure)?;
    let status = Status::of(&snapshot);
    if args.json { print_json(&status) } else { print_status(&status) }
}

pub fn serve(args: ServeArgs) -> Result<(), Failure> {
    args.threads.apply()?;
    let engine = engine(args.cache, &args.models)?;
    match engine.reload() {
        Ok(()) => {}
        Err(StoreError::Empty { path }) => {
            tracing::warn!("{} holds no scene yet; what is fetched there is served at once", path.display());
        }
        Err(error) => tracing::warn!("no scene is loaded: {}", slag_edge::error_line(&error)),
    }
    if let Ok(snapshot) = engine.snapshot()
        && let Err(error) = engine.check_encoder(&snapshot)
    {
        tracing::warn!("{error}");
    }
    let settings = Settings::default();
    let (drain, blocking_threads) = (settings.drain, settings.max_queries + SPARE_BLOCKING_THREADS);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(ASYNC_THREADS)
        .max_blocking_threads(blocking_threads)
        .enable_all()
        .build()?;
    let served = runtime.block_on(async {
        let stop = stop_signal()?;
        let listener = TcpListener::bind(args.listen).await.with_context(|| {
            format!("{} cannot be listened on; choose another address with --listen", args.listen)
        });
        let listener = listener.map_err(Failure::of("listen"))?;
        // For scripts that let the system choose a port.
        writeln!(io::stdout(), "listening on http://{}", listener.local_addr()?)?;
        Ok(http::serve(App::new(engine, settings), listener, stop).await?)
    });
    // A query that does not end must not keep the process.
    runtime.shutdown_timeout(drain);
    served
}

/// Returns a future that ends at ctrl-c or SIGTERM; the handlers are in place when this returns.
fn stop_signal() -> io::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
        tracing::info!("stopping: requests under way are finished first");
    })
}
