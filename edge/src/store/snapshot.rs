//! An open generation: a manifest and its shards, mapped and checked.

use std::sync::OnceLock;

use rayon::prelude::*;
use slag_common::manifest::Manifest;

use super::cache::{Current, EdgeCache};
use super::error::StoreError;
use super::files::Stat;
use super::objects::ObjectIndex;
use super::shard::OpenShard;

/// Attempts of a reader while fetches replace `current`.
const MAX_RACES: usize = 16;

/// An open generation: immutable however many fetches follow.
#[derive(Debug)]
pub struct Snapshot {
    /// The generation pointer it was opened from.
    pub current: Current,
    /// State of `current` just before it was read, for comparison with [`EdgeCache::current_stat`].
    pub current_stat: Option<Stat>,
    /// The manifest.
    pub manifest: Manifest,
    /// The shards, by cell id, ascending.
    pub shards: Vec<OpenShard>,
    /// Their objects.
    pub objects: ObjectIndex,
}

impl Snapshot {
    /// Opens the current generation: maps and checks every shard once.
    ///
    /// # Errors
    /// [`StoreError`]. A fetch that replaces `current` meanwhile is not an error.
    pub fn open(cache: &EdgeCache) -> Result<Self, StoreError> {
        let mut seen = None;
        for _ in 0..MAX_RACES {
            let current_stat = cache.current_stat()?;
            let current =
                cache.current()?.ok_or_else(|| StoreError::Empty { path: cache.dir().to_owned() })?;
            match Self::open_current(cache, current.clone(), current_stat) {
                // A fetch removes the files of the old `current` after it has put the new one in place.
                Err(StoreError::Missing { path }) if seen.as_ref() == Some(&current) => {
                    return Err(StoreError::Missing { path });
                }
                Err(StoreError::Missing { .. }) => seen = Some(current),
                other => return other,
            }
        }
        let what = format!("it was replaced {MAX_RACES} times while it was being opened");
        Err(StoreError::Current { path: cache.current_path(), what })
    }

    fn open_current(
        cache: &EdgeCache,
        current: Current,
        current_stat: Option<Stat>,
    ) -> Result<Self, StoreError> {
        let manifest = cache.read_manifest(current.manifest_hash, current.key)?;
        let open = |cell| OpenShard::open(cache, &manifest, current.profile, cell);
        let opened: Vec<Result<OpenShard, StoreError>> =
            beside_queries(|| current.cells.par_iter().map(open).collect());
        let shards: Vec<OpenShard> = opened.into_iter().collect::<Result<_, _>>()?;
        let objects = shards.iter().map(OpenShard::objects).collect::<Vec<_>>();
        let objects = ObjectIndex::new(&objects);
        Ok(Self { current, current_stat, manifest, shards, objects })
    }
}

/// Runs work in parallel on a pool of its own, half as large as the number of cores.
///
/// Queries are split over the global pool; a query queued there behind the checks of many shards would wait
/// for all of them.
pub(crate) fn beside_queries<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    static POOL: OnceLock<Option<rayon::ThreadPool>> = OnceLock::new();
    let pool = POOL.get_or_init(|| {
        let n_threads = std::thread::available_parallelism().map_or(1, usize::from).div_ceil(2);
        rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().ok()
    });
    match pool {
        Some(pool) => pool.install(work),
        // Slower, if there is no memory for threads.
        None => work(),
    }
}
