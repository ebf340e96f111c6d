//! The cache's folders: lists and clears them, and replaces files durably.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use slag_common::Hash32;

use super::error::FetchError;
use super::plan::{Held, Object};
use super::usage::Usage;
use crate::store::EdgeCache;

pub fn staging(cache: &EdgeCache) -> PathBuf {
    cache.dir().join("staging")
}

pub fn part_path(cache: &EdgeCache, hash: Hash32) -> PathBuf {
    staging(cache).join(format!("{hash}.part"))
}

/// Lists the shards on board and removes other files in their folder.
pub fn held_shards(cache: &EdgeCache, usage: &Usage) -> Result<BTreeMap<Hash32, Held>, FetchError> {
    let dir = cache.dir().join("shards");
    let mut held = BTreeMap::new();
    for name in cache.files().list(&dir)? {
        let path = dir.join(&name);
        match (name.parse::<Hash32>(), cache.files().stat(&path)?) {
            (Ok(hash), Some(stat)) => {
                let last_used = usage.last_used(hash);
                held.insert(hash, Held { len_bytes: stat.len_bytes, last_used });
            }
            _ => cache.files().remove(&path)?,
        }
    }
    Ok(held)
}

/// Empties `staging/` except for partial downloads still wanted.
pub fn clear_staging(cache: &EdgeCache, wanted: &[Object]) -> Result<(), FetchError> {
    let wanted: BTreeSet<PathBuf> = wanted.iter().map(|object| part_path(cache, object.hash)).collect();
    for name in cache.files().list(&staging(cache))? {
        let path = staging(cache).join(name);
        if !wanted.contains(&path) {
            cache.files().remove(&path)?;
        }
    }
    Ok(())
}

/// Removes the manifests that are not needed any more.
pub fn clear_manifests(cache: &EdgeCache, needed: &BTreeSet<Hash32>) -> Result<(), FetchError> {
    let dir = cache.dir().join("manifests");
    for name in cache.files().list(&dir)? {
        if !name.parse().is_ok_and(|hash| needed.contains(&hash)) {
            cache.files().remove(&dir.join(name))?;
        }
    }
    Ok(())
}

/// Replaces a small file durably: its path always holds the old or the new content, whole.
pub fn put(cache: &EdgeCache, bytes: &[u8], path: &Path) -> Result<(), FetchError> {
    let files = cache.files();
    let aside = staging(cache).join("put");
    files.write_from(&aside, 0, bytes)?;
    files.sync(&aside)?;
    files.rename(&aside, path)?;
    Ok(files.sync_dir(path.parent().unwrap_or(cache.dir()))?)
}
