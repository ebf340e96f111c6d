//! The cache's folders: lists and clears them, and replaces files durably.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};

use slag_common::Hash32;

use super::error::FetchError;
use super::plan::Object;
use crate::store::EdgeCache;
use crate::store::files::is_bad_medium;

pub fn staging(cache: &EdgeCache) -> PathBuf {
    cache.dir().join("staging")
}

pub fn part_path(cache: &EdgeCache, hash: Hash32) -> PathBuf {
    staging(cache).join(format!("{hash}.part"))
}

/// Removes a file. One whose inode cannot be read stays, and fails no fetch.
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
pub fn clear_staging(cache: &EdgeCache, wanted: &[Object]) -> Result<(), FetchError> {
    let wanted: BTreeSet<PathBuf> = wanted.iter().map(|object| part_path(cache, object.hash)).collect();
    for name in cache.files().list(&staging(cache))? {
        let path = staging(cache).join(name);
        if !wanted.contains(&path) {
            remove(cache, &path)?;
        }
    }
    Ok(())
}

/// Removes the manifests that are not needed any more.
pub fn clear_manifests(cache: &EdgeCache, needed: &BTreeSet<Hash32>) -> Result<(), FetchError> {
    let dir = cache.dir().join("manifests");
    for name in cache.files().list(&dir)? {
        if !name.parse().is_ok_and(|hash| needed.contains(&hash)) {
            remove(cache, &dir.join(name))?;
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
