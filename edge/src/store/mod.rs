//! The cache on the robot: where shards lie, and how a consistent set of them is opened.
//!
//! | path | what | changed by |
//! |---|---|---|
//! | `shards/HASH` | verified shards, immutable | fetch: renamed in, removed |
//! | `manifests/HASH` | verified signed manifests, immutable | fetch: renamed in, removed |
//! | `current` | [`Current`]: the generation that answers come from | fetch: replaced whole |
//! | `staging/` | downloads under way | fetch |
//! | `db/` | the fetcher's records | fetch |
//!
//! Readers need no lock: they read `current` and what it names, and start over if a fetch replaced it
//! meanwhile.

pub mod files;
pub mod mmap;
pub mod objects;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::container::ContainerError;
use slag_common::manifest::{self, CellRecord, Manifest, ManifestError, TrustedKeys};
use slag_common::objects::Objects;
use slag_common::shard::{Profile, ShardLayout, ShardView};

use files::{DiskFiles, Files, Stat};
use mmap::FileBytes;
use objects::ObjectIndex;

/// A longer `current` is damage (a cell takes about 110 bytes there).
const MAX_CURRENT_BYTES: u64 = 32 << 20;
/// How often a reader starts over because a fetch replaced `current` under it.
const MAX_RACES: usize = 16;

/// Why a cache cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The file system's error, with the path.
    #[error("{0}; check the cache's folder and its permissions")]
    Io(#[from] io::Error),
    /// Nothing was fetched yet.
    #[error("{path} holds no scene yet: fetch one first", path = path.display())]
    Empty {
        /// The cache.
        path: PathBuf,
    },
    /// The pointer to the generation is not what fetch writes.
    #[error("{path}: {what}; delete it and fetch again", path = path.display())]
    Current {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A file is not there although `current` names it.
    #[error("{path} is missing although `current` names it; fetch again", path = path.display())]
    Missing {
        /// The file.
        path: PathBuf,
    },
    /// A file's content is not the one it is named by.
    #[error("{path}: content has hash {found}, expected {expected}; delete it and fetch again", path = path.display())]
    Hash {
        /// The file.
        path: PathBuf,
        /// Hash expected.
        expected: Hash32,
        /// Hash of the content.
        found: Hash32,
    },
    /// The manifest is refused.
    #[error("{path}", path = path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
        /// Why.
        source: ManifestError,
    },
    /// The shard is damaged.
    #[error("{path}", path = path.display())]
    Shard {
        /// The file.
        path: PathBuf,
        /// Why and where.
        source: ContainerError,
    },
    /// `current` names a cell or a profile of it that the manifest does not list.
    #[error("{path}: the manifest lists no {profile} shard of cell {cell_id}; fetch again", path = path.display())]
    Unlisted {
        /// The file.
        path: PathBuf,
        /// The cell.
        cell_id: u32,
        /// The profile.
        profile: Profile,
    },
    /// The shard is sound, but not the one that the manifest describes.
    #[error("{path}: {field} is {found}, the manifest says {expected}; delete it and fetch again", path = path.display())]
    Mismatch {
        /// The file.
        path: PathBuf,
        /// What differs.
        field: &'static str,
        /// Value in the manifest.
        expected: String,
        /// Value found.
        found: String,
    },
}

/// The generation pointer: which shards of which manifest answer queries.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Current {
    /// BLAKE3 of the signed manifest.
    pub manifest_hash: Hash32,
    /// The public key that fetch accepted for it.
    pub key: Hash32,
    /// The profile of the shards.
    pub profile: Profile,
    /// Centre of the fetch, world frame.
    pub centre_in_world: DVec3,
    /// Radius of the fetch, world units.
    pub radius: f64,
    /// The cells, by id, ascending.
    pub cells: Vec<CurrentCell>,
}

/// A cell on board.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurrentCell {
    /// The cell.
    pub cell_id: u32,
    /// BLAKE3 of its shard.
    pub hash: Hash32,
    /// Length of its shard.
    pub len_bytes: u64,
}

/// A cache folder.
#[derive(Clone)]
pub struct EdgeCache {
    dir: PathBuf,
    files: Arc<dyn Files>,
}

impl EdgeCache {
    /// Names a cache folder on disk; nothing is read or made.
    pub fn open(dir: impl Into<PathBuf>) -> Self {
        Self::with_files(dir, Arc::new(DiskFiles))
    }

    /// Names a cache folder on other storage.
    pub fn with_files(dir: impl Into<PathBuf>, files: Arc<dyn Files>) -> Self {
        Self { dir: dir.into(), files }
    }

    /// Returns the folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Returns the storage.
    pub fn files(&self) -> &dyn Files {
        &*self.files
    }

    /// Returns where the generation pointer lies.
    pub fn current_path(&self) -> PathBuf {
        self.dir.join("current")
    }

    /// Returns where a shard lies.
    pub fn shard_path(&self, hash: Hash32) -> PathBuf {
        self.dir.join("shards").join(hash.to_string())
    }

    /// Returns where a manifest lies.
    pub fn manifest_path(&self, hash: Hash32) -> PathBuf {
        self.dir.join("manifests").join(hash.to_string())
    }

    /// Returns the state of `current` without opening it: it differs whenever a fetch replaced it.
    ///
    /// # Errors
    /// [`StoreError::Io`].
    pub fn current_stat(&self) -> Result<Option<Stat>, StoreError> {
        Ok(self.files.stat(&self.current_path())?)
    }

    /// Returns the generation pointer; `None` before the first fetch.
    ///
    /// # Errors
    /// [`StoreError::Io`], or [`StoreError::Current`] if it is damaged.
    pub fn current(&self) -> Result<Option<Current>, StoreError> {
        let path = self.current_path();
        let bytes = match self.files.read(&path, MAX_CURRENT_BYTES) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            other => other?,
        };
        let current: Current = serde_json::from_slice(&bytes)
            .map_err(|e| StoreError::Current { path: path.clone(), what: e.to_string() })?;
        if current.cells.windows(2).any(|pair| pair[0].cell_id >= pair[1].cell_id) {
            return Err(StoreError::Current { path, what: "cell ids do not ascend".into() });
        }
        Ok(Some(current))
    }

    /// Reads a manifest of the cache and checks its hash and its signature.
    ///
    /// # Errors
    /// [`StoreError::Missing`], [`StoreError::Hash`], [`StoreError::Manifest`].
    pub fn read_manifest(&self, hash: Hash32, key: Hash32) -> Result<Manifest, StoreError> {
        let path = self.manifest_path(hash);
        let bytes = match self.files.read(&path, manifest::MAX_BYTES) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Err(StoreError::Missing { path }),
            other => other?,
        };
        let found = Hash32::of(&bytes);
        if found != hash {
            return Err(StoreError::Hash { path, expected: hash, found });
        }
        match Manifest::verify(&bytes, &TrustedKeys::Only(vec![key])) {
            Ok((manifest, _)) => Ok(manifest),
            Err(source) => Err(StoreError::Manifest { path, source }),
        }
    }
}

/// One generation, whole: immutable however many fetches follow.
#[derive(Debug)]
pub struct Snapshot {
    /// The generation pointer it was opened from.
    pub current: Current,
    /// State of `current` just before it was read, to compare with [`EdgeCache::current_stat`].
    pub current_stat: Option<Stat>,
    /// The manifest.
    pub manifest: Manifest,
    /// The shards, by cell id, ascending.
    pub shards: Vec<OpenShard>,
    /// Their objects.
    pub objects: ObjectIndex,
}

impl Snapshot {
    /// Opens the current generation: every shard is mapped and checked once.
    ///
    /// # Errors
    /// [`StoreError`]; a fetch that replaces `current` meanwhile is none.
    pub fn open(cache: &EdgeCache) -> Result<Self, StoreError> {
        let mut seen = None;
        for _ in 0..MAX_RACES {
            let current_stat = cache.current_stat()?;
            let current = cache.current()?.ok_or_else(|| StoreError::Empty { path: cache.dir.clone() })?;
            match Self::open_current(cache, current.clone(), current_stat) {
                // A fetch removes what the old `current` named once the new one is in place.
                Err(StoreError::Missing { path }) if seen.as_ref() == Some(&current) => {
                    return Err(StoreError::Missing { path });
                }
                Err(StoreError::Missing { .. }) => seen = Some(current),
                other => return other,
            }
        }
        let what = format!("it was replaced {MAX_RACES} times while being opened");
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

/// Runs work in parallel on threads of its own, half as many as there are cores.
///
/// Queries are split over the common threads; behind the checks of many shards there, a query would wait
/// for all of them.
pub(crate) fn beside_queries<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    static POOL: OnceLock<Option<rayon::ThreadPool>> = OnceLock::new();
    let pool = POOL.get_or_init(|| {
        let n_threads = std::thread::available_parallelism().map_or(1, usize::from).div_ceil(2);
        rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().ok()
    });
    match pool {
        Some(pool) => pool.install(work),
        // Without memory for threads it takes longer.
        None => work(),
    }
}

/// A mapped and checked shard.
#[derive(Debug)]
pub struct OpenShard {
    /// What the manifest says of its cell.
    pub cell: CellRecord,
    layout: ShardLayout,
    bytes: FileBytes,
}

impl OpenShard {
    /// Returns its columns.
    pub fn view(&self) -> ShardView<'_> {
        self.layout.view(&self.bytes)
    }

    /// Returns the objects of its Gaussians, where the shard has them.
    pub fn objects(&self) -> Option<Objects<'_>> {
        self.layout.objects(&self.bytes)
    }

    /// Returns its length.
    pub fn len_bytes(&self) -> u64 {
        self.bytes.len() as u64
    }

    fn open(
        cache: &EdgeCache,
        manifest: &Manifest,
        profile: Profile,
        at: &CurrentCell,
    ) -> Result<Self, StoreError> {
        let path = cache.shard_path(at.hash);
        let bytes = match cache.files.map(&path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Err(StoreError::Missing { path }),
            other => other?,
        };
        let (cell, layout) = check_shard(&path, &bytes, at, profile, manifest)?;
        Ok(Self { cell: cell.clone(), layout, bytes })
    }
}

/// Checks that bytes are a sound shard, and the one that a manifest lists for a cell.
///
/// # Errors
/// [`StoreError::Shard`], [`StoreError::Mismatch`].
pub fn check_shard<'a>(
    path: &Path,
    bytes: &[u8],
    at: &CurrentCell,
    profile: Profile,
    manifest: &'a Manifest,
) -> Result<(&'a CellRecord, ShardLayout), StoreError> {
    let same = |field, expected: &dyn ToString, found: &dyn ToString| {
        let (expected, found) = (expected.to_string(), found.to_string());
        match expected == found {
            true => Ok(()),
            false => Err(StoreError::Mismatch { path: path.to_owned(), field, expected, found }),
        }
    };
    let position = manifest.cells.partition_point(|cell| cell.cell_id < at.cell_id);
    let cell = manifest.cells.get(position).filter(|cell| cell.cell_id == at.cell_id);
    let Some((cell, listed)) = cell.and_then(|cell| Some((cell, cell.shards.get(&profile)?))) else {
        let (cell_id, path) = (at.cell_id, path.to_owned());
        return Err(StoreError::Unlisted { path, cell_id, profile });
    };
    same("the name", &listed.hash, &at.hash)?;
    same("the length in bytes", &listed.len_bytes, &bytes.len())?;
    let layout =
        ShardLayout::check(bytes).map_err(|source| StoreError::Shard { path: path.to_owned(), source })?;
    let header = layout.header;
    same("the cell", &cell.cell_id, &header.cell_id)?;
    same("the number of Gaussians", &cell.n_gaussians, &header.n_gaussians)?;
    same("the embedding dimension", &manifest.encoder.dim, &header.dim)?;
    same("the encoder", &manifest.encoder.id, &Hash32(header.encoder_id))?;
    Ok((cell, layout))
}
