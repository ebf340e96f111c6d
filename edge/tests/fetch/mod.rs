//! Fetch and cache against a real HTTP server that misbehaves and storage that loses power.

mod crash;
mod faults;
mod follow;
mod history;
mod hostile;
mod medium;
mod partial;
mod rot;
pub mod scene;
pub mod server;
mod sim;
mod sync;
mod trust;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use glam::DVec3;
use slag_common::container::AlignedBytes;
use slag_common::retry::Backoff;
use slag_common::shard::{Profile, ShardLayout};
use slag_common::tuf::{TargetFile, TufError};
use slag_common::{Hash32, manifest};
use slag_edge::fetch::follow::{FollowEnvironment, FollowSettings, Following};
use slag_edge::fetch::{
    AddedRoot, DownloadFailure, Environment, FetchError, FetchReport, FetchRequest, FirstRoot, NetworkLimits,
    Position, Progress, Records, RecordsError, add_root, fetch,
};
use slag_edge::query::Engine;
use slag_edge::store::files::Files;
use slag_edge::store::{BadCell, CellFault, EdgeCache, Scrubber, Snapshot, StoreError};
use slag_math::random::Random;
use slag_test_support::{assert_error, trials};

use faults::text_service;
use scene::{ENCODER, FIRST, NOW, Published, RootKeys};
use server::{Fault, Seen, Server};
use sim::SimFiles;

/// Fetches with short timeouts and few retries.
#[derive(Clone)]
struct Robot {
    _dir: Option<Arc<tempfile::TempDir>>,
    cache: EdgeCache,
    request: FetchRequest,
    now_unix_secs: u64,
    limits: NetworkLimits,
}

impl Robot {
    fn new(cache: EdgeCache, from: &str) -> Self {
        let limits = NetworkLimits {
            attempts: 3,
            backoff: Backoff { first: Duration::from_millis(1), longest: Duration::from_millis(4) },
            read_timeout: Duration::from_secs(5),
            chunk_bytes: 512,
            progress_bytes: 512,
            ..NetworkLimits::default()
        };
        let request = FetchRequest {
            from: Some(from.to_owned()),
            at: Some(at(5.0)),
            radius: 20.0,
            parallel: 1,
            trust_first: true,
            ..FetchRequest::default()
        };
        Self { _dir: None, cache, request, now_unix_secs: NOW, limits }
    }

    fn of(server: &Server) -> Self {
        let dir = tempfile::tempdir().expect("temporary folder");
        let robot = Self::on_disk(dir.path(), &server.url());
        Self { _dir: Some(Arc::new(dir)), ..robot }
    }

    /// Serves a scene, for a robot without any.
    fn started(scene: Published) -> (Server, Self) {
        let server = Server::start(scene);
        let robot = Self::of(&server);
        (server, robot)
    }

    /// Serves a scene that a robot has on board.
    fn fetched(scene: Published) -> (Server, Self) {
        let (server, robot) = Self::started(scene);
        robot.fetch().expect("works");
        (server, robot)
    }

    fn on_disk(dir: &Path, from: &str) -> Self {
        Self::new(EdgeCache::open(dir.join("cache")), from)
    }

    fn on_sim(dir: &Path, files: Arc<SimFiles>, from: &str) -> Self {
        Self::new(EdgeCache::with_files(dir.join("cache"), files), from)
    }

    /// Moves it to a place, with space for the cells needed there.
    fn go(&mut self, x: f64, radius: f64, scene: &Published, cell_ids: std::ops::Range<u32>) {
        self.request.at = Some(at(x));
        self.request.radius = radius;
        self.request.max_bytes = Some(scene.bytes(cell_ids));
    }

    fn fetch(&self) -> Result<FetchReport, FetchError> {
        self.fetch_watched(&(), &AtomicBool::new(false))
    }

    fn fetch_watched(&self, progress: &dyn Progress, cancel: &AtomicBool) -> Result<FetchReport, FetchError> {
        fetch(&self.cache, &self.request, &self.environment(progress, cancel))
    }

    fn environment<'a>(&self, progress: &'a dyn Progress, cancel: &'a AtomicBool) -> Environment<'a> {
        let (now_unix_secs, limits) = (self.now_unix_secs, self.limits.clone());
        Environment { ca: None, now_unix_secs, cancel, progress, random: &|| 0.5, limits }
    }

    fn add_root(&self, root: &FirstRoot, replace: bool) -> Result<AddedRoot, FetchError> {
        let cancel = AtomicBool::new(false);
        add_root(&self.cache, root, replace, &self.environment(&(), &cancel))
    }

    fn snapshot(&self) -> Snapshot {
        Snapshot::open(&self.cache).expect("a whole generation")
    }

    fn shards(&self) -> Vec<Hash32> {
        let names = self.cache.files().list(&self.cache.dir().join("shards")).expect("there");
        names.iter().map(|name| name.parse().expect("a hash")).collect()
    }

    fn staged(&self) -> Vec<String> {
        self.cache.files().list(&self.cache.dir().join("staging")).expect("there")
    }
}

fn cells(snapshot: &Snapshot) -> Vec<u32> {
    snapshot.shards.iter().map(|shard| shard.cell.cell_id).collect()
}

fn at(x: f64) -> Position {
    Position::World(DVec3::new(x, 0.0, 105.0))
}

fn assert_holds(snapshot: &Snapshot, published: &Published, cell_ids: std::ops::Range<u32>) {
    assert_eq!(cells(snapshot), cell_ids.collect::<Vec<_>>());
    assert_eq!(snapshot.manifest, published.manifest);
    for (shard, at) in snapshot.shards.iter().zip(&snapshot.current.cells) {
        let expected = &published.objects[&published.hash(at.cell_id, snapshot.current.profile)];
        assert_eq!(shard.len_bytes(), expected.len() as u64);
        let aligned = slag_common::container::AlignedBytes::copy_of(expected);
        let layout = slag_common::shard::ShardLayout::check(&aligned).expect("sound");
        let positions = |view: slag_common::shard::ShardView<'_>| {
            (0..view.header.n_gaussians as usize).map(|at| view.position_in_world(at)).collect::<Vec<_>>()
        };
        assert_eq!(positions(shard.view()), positions(layout.view(&aligned)));
        assert_eq!(shard.view().header, layout.view(&aligned).header);
    }
}
