//! `serve`, `query` and `status`.

use std::ffi::OsString;
use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use anyhow::{Context, anyhow};
use serde::Serialize;
use slag_edge::fetch::follow::Following;
use slag_edge::http::{self, App, Settings};
use slag_edge::query::{Engine, QueryRequest, Status};
use slag_edge::store::{EdgeCache, Snapshot, StoreError};
use slag_edge::text::TextService;
use slag_models::ModelDir;
use slag_models::SessionOptions;
use slag_models::commands::{self as model_commands, RunArgs};
use slag_models::hub::cache_folder;
use slag_models::session::SessionError;
use tokio::net::TcpListener;

use super::fetch::follow_in_background;
use super::output::{Failure, print_json, print_pairs, print_reply, print_status, write_json};
use super::{CacheArgs, ModelArgs, ModelsArgs, QueryArgs, ServeArgs, StatusArgs, ThreadArgs};

/// Async threads: they only pass requests on.
const ASYNC_THREADS: usize = 2;
/// Threads of a text model: more gain little for short texts.
const MAX_MODEL_THREADS: usize = 4;
/// Threads beside those of queries, for status and for loading a generation.
const SPARE_BLOCKING_THREADS: usize = 8;

impl CacheArgs {
    /// Returns the cache named, or the user's own.
    pub fn open(self) -> Result<EdgeCache, Failure> {
        let dir = self.cache.or_else(|| cache_folder(variable));
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

fn engine(cache: EdgeCache, models: &ModelArgs) -> Result<Engine, Failure> {
    let (models, options) = text_model(models)?;
    let text = TextService::open(&models, &options);
    Ok(Engine::new(cache, text.map_err(|e| Failure::Failed("models", e.into()))?))
}

/// Returns the models that the text model is of, and how it is run.
pub fn text_model(args: &ModelArgs) -> Result<(ModelDir, SessionOptions), Failure> {
    let failed = Failure::of("models");
    let models = model_commands::open(args.models.as_deref(), &variable);
    let options = session_options(&args.how).map_err(|e| failed(e.into()))?;
    Ok((models.map_err(|e| failed(e.into()))?, options))
}

/// Returns how models are run: one text at a time, with a few threads.
fn session_options(how: &RunArgs) -> Result<SessionOptions, SessionError> {
    let exe = std::env::current_exe().unwrap_or_default();
    let n_cores = std::thread::available_parallelism().map_or(1, usize::from);
    how.session_options(&model_commands::runtime_folders(&exe), n_cores.min(MAX_MODEL_THREADS))
}

fn variable(name: &str) -> Option<OsString> {
    std::env::var_os(name)
}

pub fn models(args: ModelsArgs) -> Result<(), Failure> {
    let context = model_commands::Context {
        variable: &variable,
        image: None,
        ask: &|question| !args.json && model_commands::ask(question),
        session: &session_options,
    };
    let report = model_commands::run(&args.command, &context);
    let report = report.map_err(|e| Failure::Failed("models", e.into()))?;
    match args.json {
        true => print_json(&report),
        false => Ok(write!(io::stdout(), "{report}")?),
    }
}

/// Tells apart that nothing is on board yet.
pub fn store_failure(error: StoreError) -> Failure {
    let kind = if matches!(error, StoreError::Empty { .. }) { "no-scene" } else { "store" };
    Failure::Failed(kind, error.into())
}

pub fn query(args: QueryArgs) -> Result<(), Failure> {
    let request = QueryRequest {
        texts: vec![args.text],
        negatives: args.negatives,
        limit: args.limit,
        threshold: args.threshold,
        near: args.near,
        radius: args.radius,
        bounds: args.bounds,
        kind: args.kind,
        voxel: args.voxel,
        min_count: args.min_count,
        precision: args.precision,
    };
    request.check().map_err(|e| Failure::Usage(e.into()))?;
    args.threads.apply()?;
    let engine = engine(args.cache.open()?, &args.models)?;
    engine.reload().map_err(store_failure)?;
    let reply = engine.answer(&request)?;
    if args.json { write_json(reply) } else { print_reply(&reply) }
}

pub fn status(args: StatusArgs) -> Result<(), Failure> {
    let snapshot = Snapshot::open(&args.cache.open()?).map_err(store_failure)?;
    let status = Status::of(&snapshot);
    let expires_unix_secs = snapshot.manifest.expires_unix_secs;
    let is_expired = snapshot.manifest.check_expiry(slag_edge::now_unix_secs()).is_err();
    if args.json {
        return print_json(&OnBoard { status: &status, expires_unix_secs, is_expired });
    }
    print_status(&status)?;
    match is_expired {
        true => print_pairs(&[("expired", "yes: it still answers, but fetch refuses it".into())]),
        false => Ok(()),
    }
}

#[derive(Serialize)]
struct OnBoard<'a> {
    #[serde(flatten)]
    status: &'a Status,
    expires_unix_secs: Option<u64>,
    is_expired: bool,
}

pub fn serve(mut args: ServeArgs) -> Result<(), Failure> {
    args.threads.apply()?;
    let cache = std::mem::replace(&mut args.cache, CacheArgs { cache: None }).open()?;
    let engine = engine(cache.clone(), &args.models)?;
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
        let following = args.follow.is_some().then(Arc::<Following>::default);
        let app = App::following(engine, settings, following.clone());
        let follower = match following {
            Some(following) => Some(follow_in_background(&args, cache, following, Arc::clone(&app))?),
            None => None,
        };
        let served = http::serve(app, listener, stop).await;
        // A fetch under way need not be waited for: the next one goes on where it is cut off.
        follower.inspect(|cancel| cancel.store(true, Ordering::Relaxed));
        Ok(served?)
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
