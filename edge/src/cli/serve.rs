//! `serve`.

use std::io::{self, Write};
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use clap::Args;
use slag_common::Hash32;
use slag_common::shard::Profile;
use slag_edge::fetch::FetchRequest;
use slag_edge::fetch::follow::Following;
use slag_edge::http::{self, App, Settings};
use slag_edge::store::StoreError;
use slag_service::listener::bind;
use slag_service::stop::stop_signal;

use super::args::{CacheArgs, ModelArgs, ThreadArgs, engine, profile_parser};
use super::failure::Failure;
use super::follow::{FollowArgs, follow_in_background};
use super::network::checked_keys;

/// Async threads: they only forward requests.
const ASYNC_THREADS: usize = 2;
/// Blocking threads in addition to those of queries, for status and for loading a generation.
const SPARE_BLOCKING_THREADS: usize = 8;

#[derive(Debug, Args)]
pub struct ServeArgs {
    /// Address to listen on.
    #[arg(long, value_name = "IP:PORT", default_value = "127.0.0.1:7734")]
    pub listen: SocketAddr,
    /// Follow the robot: fetch from this store around the positions posted to POST /position.
    #[arg(long, value_name = "URL")]
    pub follow: Option<String>,
    /// When following: radius around the robot within which cells are kept, world units.
    #[arg(long, default_value_t = 50.0)]
    pub radius: f64,
    /// When following: profile of the shards.
    #[arg(long, default_value_t = Profile::Compact, value_parser = profile_parser())]
    pub profile: Profile,
    /// When following: the only public keys accepted, at most two.
    #[arg(long, value_name = "HEX")]
    pub key: Vec<Hash32>,
    /// When following: byte budget for shards [default: twice what the radius needs].
    #[arg(long, value_name = "N")]
    pub max_bytes: Option<u64>,
    #[command(flatten)]
    pub following: FollowArgs,
    #[command(flatten)]
    pub threads: ThreadArgs,
    #[command(flatten)]
    pub cache: CacheArgs,
    #[command(flatten)]
    pub models: ModelArgs,
}

pub fn run(mut args: ServeArgs) -> Result<(), Failure> {
    args.threads.apply()?;
    let cache = std::mem::replace(&mut args.cache, CacheArgs { cache: None }).open()?;
    let engine = engine(cache.clone(), &args.models)?;
    match engine.reload() {
        Ok(()) => {}
        Err(StoreError::Empty { path }) => {
            tracing::warn!("{} holds no scene yet; a scene fetched there is served at once", path.display());
        }
        Err(error) => tracing::warn!("no scene is loaded: {}", slag_edge::error_line(&error)),
    }
    if let Ok(snapshot) = engine.snapshot()
        && let Err(error) = engine.check_encoder(&snapshot)
    {
        tracing::warn!("{error}");
    }
    let settings = Settings::default();
    let (drain, blocking_threads) =
        (settings.connections.drain_timeout, settings.max_queries + SPARE_BLOCKING_THREADS);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(ASYNC_THREADS)
        .max_blocking_threads(blocking_threads)
        .enable_all()
        .build()?;
    let served = runtime.block_on(async {
        let stop = stop_signal()?;
        let listener = bind(args.listen).await.map_err(|e| Failure::Failed("listen", e.into()))?;
        // For scripts that let the system choose a port.
        writeln!(io::stdout(), "listening on http://{}", listener.local_addr()?)?;
        let following = args.follow.is_some().then(Arc::<Following>::default);
        let app = App::following(engine, settings, following.clone());
        let follower = match following {
            Some(following) => {
                let request = FetchRequest {
                    from: args.follow.clone(),
                    profile: args.profile,
                    keys: checked_keys(args.key.clone())?,
                    max_bytes: args.max_bytes,
                    ..FetchRequest::default()
                };
                let settings = args.following.settings(args.radius)?;
                Some(follow_in_background(request, settings, cache, following, Arc::clone(&app))?)
            }
            None => None,
        };
        let served = http::serve(app, listener, stop).await;
        // A fetch in progress need not be awaited: the next one resumes it.
        follower.inspect(|cancel| cancel.store(true, Ordering::Relaxed));
        Ok(served?)
    });
    // A query that does not end must not keep the process alive.
    runtime.shutdown_timeout(drain);
    served
}
