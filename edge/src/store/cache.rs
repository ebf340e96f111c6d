//! A cache folder and the generation pointer in it. Cells with shards that could not be fetched or opened cost that
//! cell only.

use std::collections::BTreeSet;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::{self, CellRecord, Manifest};
use slag_common::shard::Profile;

use super::error::StoreError;
use super::files::{DiskFiles, Files, Stat};

/// A longer `current` is damaged (a cell takes about 110 bytes).
const MAX_CURRENT_BYTES: u64 = 32 << 20;

/// Largest coordinate of a scene, world units.
const MAX_COORDINATE: f64 = 1e9;

/// The generation pointer: the manifest and shards that answer queries.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Current {
    /// BLAKE3 of the manifest.
    pub manifest_hash: Hash32,
    pub profile: Profile,
    pub centre_in_world: DVec3,
    /// Radius of the fetch, world units.
    pub radius: f64,
    /// The cells on board, by id, ascending.
    pub cells: Vec<CurrentCell>,
    /// The other cells within the radius, whose shards could not be fetched; by id, ascending.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub bad_cells: Vec<BadCell>,
}

impl Current {
    pub fn shards(&self) -> impl Iterator<Item = Hash32> + '_ {
        let old = self.old_shards().map(|(_, old)| old.hash);
        self.cells.iter().map(|cell| cell.hash).chain(old)
    }

    pub(crate) fn old_shards(&self) -> impl Iterator<Item = (u32, OldShard)> + '_ {
        self.bad_cells.iter().filter_map(|bad| Some((bad.cell_id, bad.old?)))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurrentCell {
    pub cell_id: u32,
    /// BLAKE3 of its shard.
    pub hash: Hash32,
    pub len_bytes: u64,
}

/// Why a cell's shard is not on board.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum CellFault {
    /// The store does not have it.
    Missing,
    /// The store's bytes have another hash or length than the manifest lists.
    Damaged,
    /// It has its hash, but is not the shard that the manifest describes.
    Invalid,
    /// Its file on board is missing, damaged or cannot be read.
    Unreadable,
}

/// A cell whose shard does not answer, although it is within the radius.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BadCell {
    /// The cell.
    pub cell_id: u32,
    /// The fault of its shard.
    pub fault: CellFault,
    /// Its shard of an earlier generation, which answers in its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub old: Option<OldShard>,
}

impl fmt::Display for BadCell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { cell_id, fault, old } = self;
        let fault = match fault {
            CellFault::Missing => "missing",
            CellFault::Damaged => "damaged",
            CellFault::Invalid => "invalid",
            CellFault::Unreadable => "unreadable on board",
        };
        write!(f, "{cell_id} ({fault}")?;
        match old {
            Some(old) => write!(f, ", generation {} answers)", old.generation),
            None => f.write_str(")"),
        }
    }
}

/// A shard of an earlier generation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OldShard {
    /// The generation.
    pub generation: u64,
    /// BLAKE3 of its manifest, which is kept on board.
    pub manifest_hash: Hash32,
    /// BLAKE3 of the shard.
    pub hash: Hash32,
    /// Length of the shard.
    pub len_bytes: u64,
}

impl OldShard {
    pub(crate) fn of_cell(self, cell_id: u32) -> CurrentCell {
        CurrentCell { cell_id, hash: self.hash, len_bytes: self.len_bytes }
    }
}

pub fn cell_of(manifest: &Manifest, cell_id: u32) -> Option<&CellRecord> {
    let position = manifest.cells.partition_point(|cell| cell.cell_id < cell_id);
    manifest.cells.get(position).filter(|cell| cell.cell_id == cell_id)
}

/// Returns whether an earlier generation's shard of a cell may be used with a new generation: both describe the same
/// Gaussians, in the same frame and embedding space.
pub fn can_stand_in(old: &Manifest, new: &Manifest, cell_id: u32) -> bool {
    let is_same_scene = old.scene == new.scene
        && (old.encoder.id, old.encoder.dim) == (new.encoder.id, new.encoder.dim)
        && (old.metric, old.geo_reference) == (new.metric, new.geo_reference);
    let same_cell = |(old, new): (&CellRecord, &CellRecord)| {
        old.bounds == new.bounds && old.n_gaussians == new.n_gaussians
    };
    is_same_scene && cell_of(old, cell_id).zip(cell_of(new, cell_id)).is_some_and(same_cell)
}

#[derive(Clone)]
pub struct EdgeCache {
    dir: PathBuf,
    files: Arc<dyn Files>,
}

impl EdgeCache {
    /// Names a cache folder on disk, without reading or creating anything.
    pub fn open(dir: impl Into<PathBuf>) -> Self {
        Self::with_files(dir, Arc::new(DiskFiles))
    }

    /// Names a cache folder on other storage.
    pub fn with_files(dir: impl Into<PathBuf>, files: Arc<dyn Files>) -> Self {
        Self { dir: dir.into(), files }
    }

    pub fn dir(&self) -> &Path {
        &self.dir
    }

    pub fn files(&self) -> &dyn Files {
        &*self.files
    }

    /// Creates a folder of the cache, durably. A file in its place is removed, as is a folder in a file's place; the
    /// user's own path and links stay.
    pub fn create_dir(&self, dir: &Path) -> io::Result<()> {
        let made = self.files.create_dir(dir);
        let is_taken = made.as_ref().is_err_and(|e| e.kind() == io::ErrorKind::AlreadyExists);
        if !is_taken || dir == self.dir || self.files.stat(dir)?.is_none() {
            return made;
        }
        self.files.remove(dir)?;
        self.files.create_dir(dir)
    }

    pub fn current_path(&self) -> PathBuf {
        self.dir.join("current")
    }

    pub fn shard_path(&self, hash: Hash32) -> PathBuf {
        self.dir.join("shards").join(hash.to_string())
    }

    pub fn manifest_path(&self, hash: Hash32) -> PathBuf {
        self.dir.join("manifests").join(hash.to_string())
    }

    /// Returns the state of `current` without opening it; changes with every replacement by a fetch.
    pub fn current_stat(&self) -> Result<Option<Stat>, StoreError> {
        Ok(self.files.stat(&self.current_path())?)
    }

    /// Returns the generation pointer; `None` before the first fetch.
    pub fn current(&self) -> Result<Option<Current>, StoreError> {
        let path = self.current_path();
        let bytes = match self.files.read(&path, MAX_CURRENT_BYTES) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            other => other?,
        };
        let current: Current = serde_json::from_slice(&bytes)
            .map_err(|e| StoreError::Current { path: path.clone(), what: e.to_string() })?;
        let Current { centre_in_world, radius, .. } = &current;
        let is_place = centre_in_world.abs().max_element() <= MAX_COORDINATE && *radius >= 0.0;
        if !is_place {
            let what = format!("it was fetched within {radius} of {centre_in_world}, which is no place");
            return Err(StoreError::Current { path, what });
        }
        let ids = || current.cells.iter().map(|cell| cell.cell_id);
        let bad_ids = || current.bad_cells.iter().map(|cell| cell.cell_id);
        if !ids().is_sorted_by(|a, b| a < b) || !bad_ids().is_sorted_by(|a, b| a < b) {
            return Err(StoreError::Current { path, what: "cell ids do not ascend".into() });
        }
        if bad_ids().any(|id| current.cells.binary_search_by_key(&id, |cell| cell.cell_id).is_ok()) {
            return Err(StoreError::Current { path, what: "a cell is on board and bad".into() });
        }
        Ok(Some(current))
    }

    pub fn read_manifest(&self, hash: Hash32) -> Result<Manifest, StoreError> {
        let path = self.manifest_path(hash);
        let bytes = self.files.read(&path, manifest::MAX_BYTES).map_err(StoreError::missing(&path))?;
        StoreError::check_hash(&path, hash, &bytes)?;
        Manifest::parse(&bytes).map_err(|source| StoreError::Manifest { path, source })
    }

    fn damaged_dir(&self) -> PathBuf {
        self.dir.join("damaged")
    }

    /// Marks a shard that was found damaged, `damaged/HASH` (empty), as readers hold no lock. It is not opened any
    /// more, and the next fetch replaces it unread: mapping an unreadable sector ends the program. Without the mark it
    /// is found within a day.
    pub(crate) fn mark_damaged(&self, hash: Hash32) {
        let path = self.damaged_dir().join(hash.to_string());
        let made = self.create_dir(&self.damaged_dir());
        if let Err(e) = made.and_then(|()| self.files.write_from(&path, 0, &[])) {
            tracing::warn!("a damaged shard is not marked, so that it is downloaded again later: {e}");
        }
    }

    pub(crate) fn marked_as_damaged(&self) -> BTreeSet<Hash32> {
        let names = self.files.list(&self.damaged_dir()).unwrap_or_default();
        names.iter().filter_map(|name| name.parse().ok()).collect()
    }

    /// Removes marks of shards that were replaced or are no longer on board.
    pub(crate) fn unmark<'a>(&self, mut hashes: impl Iterator<Item = &'a Hash32>) -> io::Result<()> {
        hashes.try_for_each(|hash| self.files.remove(&self.damaged_dir().join(hash.to_string())))
    }
}
