//! `serve`.

use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::anyhow;
use clap::Args;
use sd_notify::NotifyState;
use slag_service::access::{Access, AccessSettings};
use slag_service::listen::{Listen, answers, bind};
use slag_service::stop::stop_signal;
use slag_service::tls::{Tls, TlsFiles};

use super::args::{CacheArgs, DownloadArgs, EngineArgs, engine, parse_bytes, parse_store};
use super::failure::Failure;
use super::follow::{FollowArgs, follow_in_background};
use crate::fetch::follow::Following;
use crate::http::{self, App, Settings};
use crate::query::Engine;
use crate::store::{EdgeCache, StoreError};

/// Async threads: they only forward requests.
const ASYNC_THREADS: usize = 2;
/// Blocking threads besides those of queries, for status and loading.
const SPARE_BLOCKING_THREADS: usize = 8;

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-edge serve\n\
    \x20 slag-edge serve --follow http://BASE:7733 --radius 50\n\
    \x20 slag-edge serve --listen 0.0.0.0:7734 --token-file token\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct ServeArgs {
    /// Address to listen on, or unix:PATH.
    #[arg(long, value_name = "IP:PORT|unix:PATH", default_value = "127.0.0.1:7734")]
    pub listen: Listen,
    /// Name that clients call this machine by, besides localhost and IP addresses; other names are refused. May be
    /// repeated.
    #[arg(long, value_name = "NAME")]
    pub host: Vec<String>,
    /// Let pages of this origin ask and read answers (CORS), such as https://map.example. May be repeated.
    #[arg(long, value_name = "ORIGIN")]
    pub cors: Vec<String>,
    /// File with the bearer token that POST needs; beyond this machine nothing is taken without one.
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Speak TLS with this certificate and the chain to its authority (PEM); it is read anew when it changes.
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub tls_cert: Option<PathBuf>,
    /// Private key of --tls-cert (PEM).
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    pub tls_key: Option<PathBuf>,
    /// Most memory that one query may use, bytes; all in progress together may use four times as many.
    #[arg(long, value_name = "SIZE", default_value = "256MiB", value_parser = parse_query_bytes)]
    pub max_query_bytes: u64,
    /// Most time that one query may take, seconds.
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=3600))]
    pub max_query_secs: u64,
    /// Read every shard on board again within this time, seconds, evenly; 0: never. One that rotted costs its cell
    /// only, and the next fetch replaces it.
    #[arg(long, value_name = "S", default_value_t = 24 * 3600)]
    pub scrub_secs: u64,
    /// Follow the robot: fetch from this store around the positions posted to POST /position.
    #[arg(long, value_name = "URL", value_parser = parse_store)]
    pub follow: Option<String>,
    #[command(flatten, next_help_heading = "When following")]
    pub download: DownloadArgs,
    #[command(flatten)]
    pub following: FollowArgs,
    #[command(flatten)]
    pub engine: EngineArgs,
}

pub fn run(mut args: ServeArgs) -> Result<(), Failure> {
    args.engine.set_threads()?;
    let access = access(&mut args)?;
    let tls = tls(&mut args)?;
    let cache = std::mem::replace(&mut args.engine.cache, CacheArgs { cache: None }).open()?;
    if let Some(path) = open_to_everybody(&cache) {
        tracing::warn!(
            "everybody on this machine may write to {path}, and so decide what this robot answers until its next \
             fetch; run `chmod o-w {path}`",
            path = path.display()
        );
    }
    let engine = engine(cache.clone(), &args.engine.models)?;
    load(&engine);
    let query_timeout = Duration::from_secs(args.max_query_secs);
    let settings = Settings { access, ..Settings::with_budget(args.max_query_bytes, query_timeout) };
    let (drain, blocking_threads) =
        (settings.connections.drain_timeout, settings.max_queries + SPARE_BLOCKING_THREADS);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(ASYNC_THREADS)
        .max_blocking_threads(blocking_threads)
        .enable_all()
        .build()?;
    let served = runtime.block_on(serve(args, tls, cache, engine, settings));
    // A stuck query must not keep the process alive.
    runtime.shutdown_timeout(drain);
    served
}

async fn serve(
    args: ServeArgs,
    tls: Option<Tls>,
    cache: EdgeCache,
    engine: Engine,
    settings: Settings,
) -> Result<(), Failure> {
    let stop = stop_signal()?;
    let listener = bind(&args.listen).await.map_err(|e| Failure::failed("listen", e))?;
    let listener = listener.with_tls(tls);
    // For scripts that let the system choose a port.
    let url = listener.url()?;
    let _ = writeln!(io::stdout(), "listening on {url}");
    let following = args.follow.is_some().then(Arc::<Following>::default);
    let app = App::following(engine, settings, following.clone());
    let follower = match following {
        Some(following) => {
            let settings = args.following.settings(args.download.radius);
            let ca = args.download.ca.clone();
            let request = args.download.request(args.follow, None);
            Some(follow_in_background(request, ca, settings, cache, following, Arc::clone(&app))?)
        }
        None => None,
    };
    let scrub = scrub_in_background(&app, args.scrub_secs)?;
    tell(NotifyState::Ready);
    tokio::spawn(async move { pulse(|| answers(&url)).await });
    let stop = async {
        stop.await;
        tell(NotifyState::Stopping);
    };
    let served = http::serve(app, listener, stop).await;
    // A fetch in progress need not finish: the next one resumes it.
    [follower, scrub].iter().flatten().for_each(|cancel| cancel.store(true, Ordering::Relaxed));
    Ok(served?)
}

/// Loads the current generation, if any, and starts naming its things.
fn load(engine: &Engine) {
    match engine.reload() {
        Ok(()) => {}
        Err(StoreError::Empty { path }) => {
            tracing::warn!("{} holds no scene yet; a scene fetched there is served at once", path.display());
        }
        Err(error) => tracing::warn!("no scene is loaded: {}", crate::error_line(&error)),
    }
    if let Ok(on_board) = engine.on_board()
        && let Err(error) = on_board.check()
    {
        tracing::warn!("{error}");
    }
    engine.begin_names();
}

fn tls(args: &mut ServeArgs) -> Result<Option<Tls>, Failure> {
    let files = match (args.tls_cert.take(), args.tls_key.take()) {
        (Some(cert), Some(key)) => Some(TlsFiles { cert, key }),
        (None, None) => None,
        // One of them may come from the configuration.
        _ => {
            let what = anyhow!("TLS needs both --tls-cert and --tls-key; give both, or neither");
            return Err(Failure::usage(what));
        }
    };
    args.listen.tls(files).map_err(Failure::usage)
}

/// Returns a cache folder that every user may write to: answers come from files checked only by hash.
fn open_to_everybody(cache: &EdgeCache) -> Option<PathBuf> {
    let folders = ["", "manifests", "shards", "trust"].map(|name| cache.dir().join(name));
    let is_open = |path: &PathBuf| {
        fs_err::metadata(path).is_ok_and(|metadata| metadata.permissions().mode() & 0o002 != 0)
    };
    folders.into_iter().find(is_open)
}

fn parse_query_bytes(text: &str) -> Result<u64, String> {
    match parse_bytes(text).map_err(|e| e.to_string())? {
        bytes if bytes < 1 << 20 => Err("expected 1MiB or more".into()),
        bytes => Ok(bytes),
    }
}

/// Scrubs on a separate thread until the returned flag is set.
fn scrub_in_background(app: &Arc<App>, secs: u64) -> Result<Option<Arc<AtomicBool>>, Failure> {
    if secs == 0 {
        return Ok(None);
    }
    let (app, cancel) = (Arc::clone(app), Arc::<AtomicBool>::default());
    let stop = Arc::clone(&cancel);
    let scrub = move || http::keep_scrubbing(&app, Duration::from_secs(secs), &stop);
    std::thread::Builder::new().name("scrub".into()).spawn(scrub)?;
    Ok(Some(cancel))
}

fn access(args: &mut ServeArgs) -> Result<Access, Failure> {
    let settings = AccessSettings {
        hosts: std::mem::take(&mut args.host),
        origins: std::mem::take(&mut args.cors),
        token_file: args.token_file.take(),
    };
    let access = Access::new(&args.listen, settings).map_err(Failure::usage)?;
    if args.follow.is_some() && !access.takes_writes() {
        return Err(Failure::usage(anyhow!(
            "--follow needs positions, and on {} everybody could post them; give --token-file FILE, or listen on \
             127.0.0.1 or unix:PATH",
            args.listen
        )));
    }
    Ok(access)
}

/// Pulses within systemd's watchdog timeout; it advises two.
const PULSES_PER_TIMEOUT: u32 = 3;

fn tell(news: NotifyState<'_>) {
    if let Err(error) = sd_notify::notify(std::slice::from_ref(&news)) {
        tracing::warn!("systemd was not told {news:?}: {error}");
    }
}

/// Reports that the service is alive, as long as `is_alive` says so in time; returns at once without a watchdog.
async fn pulse<A: Future<Output = bool>>(is_alive: impl Fn() -> A) {
    let timeout = sd_notify::watchdog_enabled();
    let Some(pulse) = timeout.map(|timeout| timeout / PULSES_PER_TIMEOUT).filter(|pulse| !pulse.is_zero())
    else {
        return;
    };
    loop {
        match tokio::time::timeout(pulse, is_alive()).await {
            Ok(true) => tell(NotifyState::Watchdog),
            _ => tracing::error!("the service does not answer itself; its supervisor may end it"),
        }
        tokio::time::sleep(pulse).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cache_that_others_may_write_is_warned_of() {
        let dir = tempfile::tempdir().expect("a folder");
        let cache = EdgeCache::open(dir.path());
        let shards = dir.path().join("shards");
        fs_err::create_dir(&shards).expect("made");
        let with_mode = |path: &PathBuf, mode: u32| {
            fs_err::set_permissions(path, PermissionsExt::from_mode(mode)).expect("set");
            open_to_everybody(&cache)
        };
        assert_eq!(with_mode(&shards, 0o775), None);
        assert_eq!(with_mode(&shards, 0o777), Some(shards.clone()));
        assert_eq!(with_mode(&shards, 0o755), None);
        let root = dir.path().to_owned();
        assert_eq!(with_mode(&root, 0o1777), Some(root.join("")));
    }
}
