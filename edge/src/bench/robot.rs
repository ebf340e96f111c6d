//! A store and a robot's service that fetches from it, through real sockets and files.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use glam::DVec3;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

use super::scene::{Shelf, store, text_service};
use crate::fetch::{Environment, FetchError, FetchRequest, NetworkLimits, Position, fetch};
use crate::http::{self, App, Settings};
use crate::query::Engine;
use crate::store::EdgeCache;

/// Reasons for a failed measurement.
#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    /// A socket or file failed.
    #[error("{0}; check the work folder and the loopback network")]
    Io(#[from] io::Error),
    /// A fetch failed.
    #[error(transparent)]
    Fetch(#[from] FetchError),
    /// A query got no answer.
    #[error("a query got no answer: {what}; see the service's log")]
    Query {
        /// The answer received instead.
        what: String,
    },
}

/// A robot's service and the store it fetches from.
pub(super) struct Robot {
    /// The service's address.
    pub service: String,
    cache: EdgeCache,
    app: Arc<App>,
    request: FetchRequest,
    runtime: Runtime,
}

impl Robot {
    /// Starts both; nothing is on board yet. The cache lies in the work folder.
    pub fn start(shelf: &Shelf, dim: u32, work_dir: &Path) -> io::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
        let cache = EdgeCache::open(work_dir.join("cache"));
        let app = App::new(Engine::new(cache.clone(), text_service(dim)?), Settings::default());
        let (from, service) = runtime.block_on(async {
            let (cloud, robot) =
                (TcpListener::bind("127.0.0.1:0").await?, TcpListener::bind("127.0.0.1:0").await?);
            let urls = (format!("http://{}", cloud.local_addr()?), format!("http://{}", robot.local_addr()?));
            tokio::spawn(axum::serve(cloud, store(Arc::clone(shelf))).into_future());
            tokio::spawn(http::serve(Arc::clone(&app), robot, std::future::pending()));
            Ok::<_, io::Error>(urls)
        })?;
        let request = FetchRequest {
            from: Some(from),
            at: Some(Position::World(DVec3::ZERO)),
            radius: 1e6,
            trust_first: true,
            ..FetchRequest::default()
        };
        Ok(Self { service, cache, app, request, runtime })
    }

    /// Fetches and loads what the store has; returns the bytes that were downloaded.
    pub fn fetch(&self) -> Result<u64, FetchError> {
        let environment = Environment {
            ca: None,
            now_unix_secs: crate::clock::now_unix_secs(),
            cancel: &AtomicBool::new(false),
            progress: &(),
            random: &|| 0.5,
            limits: NetworkLimits::default(),
        };
        let report = fetch(&self.cache, &self.request, &environment)?;
        self.app.reload_now();
        Ok(report.downloaded.bytes)
    }

    /// Ends both and removes the cache.
    pub fn end(self) -> io::Result<()> {
        self.runtime.shutdown_background();
        fs_err::remove_dir_all(self.cache.dir())
    }
}
