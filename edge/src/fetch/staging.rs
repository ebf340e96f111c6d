//! The cache's folders: lists and clears them, and replaces files durably.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::ObjectRecord;

use super::error::FetchError;
use super::plan::Held;
use crate::store::EdgeCache;
use crate::store::files::{is_bad_medium, put_through};

pub fn staging(cache: &EdgeCache) -> PathBuf {
    cache.dir().join("staging")
}

pub fn part_path(cache: &EdgeCache, hash: Hash32) -> PathBuf {
    staging(cache).join(format!("{hash}.part"))
}

/// Removes a file. One with an unreadable inode stays without failing the fetch.
pub fn remove(cache: &EdgeCache, path: &Path) -> io::Result<()> {
    match cache.files().remove(path) {
        Err(e) if is_bad_medium(&e) => {
            tracing::warn!("{e}; the file system needs a check (fsck)");
            Ok(())
        }
        other => other,
    }
}

/// Empties `staging/` except for partial downloads still wanted.
pub fn clear_staging(cache: &EdgeCache, wanted: &[ObjectRecord]) -> Result<(), FetchError> {
    let wanted: BTreeSet<PathBuf> = wanted.iter().map(|object| part_path(cache, object.hash)).collect();
    for name in cache.files().list(&staging(cache))? {
        let path = staging(cache).join(name);
        if !wanted.contains(&path) {
            remove(cache, &path)?;
        }
    }
    Ok(())
}

pub fn clear_manifests(cache: &EdgeCache, needed: &BTreeSet<Hash32>) -> Result<(), FetchError> {
    let dir = cache.dir().join("manifests");
    for name in cache.files().list(&dir)? {
        if !name.parse().is_ok_and(|hash| needed.contains(&hash)) {
            remove(cache, &dir.join(name))?;
        }
    }
    Ok(())
}

/// Names tried in `staging/` before the medium counts as failed.
const MAX_BAD_NAMES: u32 = 4;

/// Replaces a small file durably: its path always holds the old or the new content, whole.
pub fn put(cache: &EdgeCache, bytes: &[u8], path: &Path) -> Result<(), FetchError> {
    let mut n = 0;
    loop {
        let aside = staging(cache).join(format!("put{n}"));
        match put_through(cache.files(), &aside, bytes, path) {
            // The name stays taken if its inode cannot be read.
            Err(e) if is_bad_medium(&e) && n < MAX_BAD_NAMES => n += 1,
            other => return Ok(other?),
        }
    }
}

/// A longer file is damaged; a shard takes about 80 bytes.
const MAX_BYTES: u64 = 16 << 20;

#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Usage {
    n_fetches: u64,
    /// Number of the last fetch that needed a shard on board.
    last_used: BTreeMap<Hash32, u64>,
}

fn path(cache: &EdgeCache) -> PathBuf {
    cache.dir().join("usage.json")
}

impl Usage {
    /// Reads the records; empty if missing or damaged.
    pub fn open(cache: &EdgeCache) -> Self {
        let path = path(cache);
        let read = cache.files().read(&path, MAX_BYTES).and_then(|bytes| Ok(serde_json::from_slice(&bytes)?));
        read.unwrap_or_else(|e: io::Error| {
            if e.kind() != io::ErrorKind::NotFound {
                tracing::warn!("{} is made anew: {e}", path.display());
            }
            Self::default()
        })
    }

    /// Lists the shards on board and removes other files in their folder.
    pub(crate) fn held_shards(&self, cache: &EdgeCache) -> Result<BTreeMap<Hash32, Held>, FetchError> {
        let dir = cache.dir().join("shards");
        let mut held = BTreeMap::new();
        for name in cache.files().list(&dir)? {
            let path = dir.join(&name);
            match (name.parse::<Hash32>(), cache.files().stat(&path)) {
                (Ok(hash), Ok(Some(stat))) => {
                    let last_used = self.last_used.get(&hash).copied().unwrap_or(0);
                    held.insert(hash, Held { len_bytes: stat.len_bytes, last_used });
                }
                (Err(_), Ok(_)) => remove(cache, &path)?,
                (_, Ok(None)) => {}
                // Treated as missing: it costs its cell only.
                (_, Err(e)) => tracing::warn!("{e}; the file system needs a check (fsck)"),
            }
        }
        Ok(held)
    }

    /// Records the shards that a fetch needed; forgets those no longer on board.
    pub fn finish(mut self, cache: &EdgeCache, needed: &BTreeSet<Hash32>, on_board: &BTreeSet<Hash32>) {
        self.n_fetches = self.n_fetches.saturating_add(1);
        self.last_used.extend(needed.iter().map(|shard| (*shard, self.n_fetches)));
        self.last_used.retain(|shard, _| on_board.contains(shard));
        let bytes = serde_json::to_vec(&self).expect("numbers and text become JSON");
        if let Err(e) = put(cache, &bytes, &path(cache)) {
            tracing::warn!("this fetch keeps no record of use: {e}");
        }
    }
}
