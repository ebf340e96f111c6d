//! Shards on board found damaged. Readers hold no lock, so they only leave a mark, `damaged/HASH` (empty). Marked
//! shards are not opened, and the next fetch replaces them unread: mapping an unreadable sector ends the program.

use std::collections::BTreeSet;

use slag_common::Hash32;

use super::cache::EdgeCache;

/// Marks a shard. Without the mark it is found within a day.
pub fn mark(cache: &EdgeCache, hash: Hash32) {
    let dir = cache.damaged_dir();
    let marked = cache.create_dir(&dir).and_then(|()| {
        let path = dir.join(hash.to_string());
        cache.files().write_from(&path, 0, &[])
    });
    if let Err(e) = marked {
        tracing::warn!("a damaged shard is not marked, so that it is downloaded again later: {e}");
    }
}

pub fn marked(cache: &EdgeCache) -> BTreeSet<Hash32> {
    let names = cache.files().list(&cache.damaged_dir()).unwrap_or_default();
    names.iter().filter_map(|name| name.parse().ok()).collect()
}

/// Removes marks of shards that were replaced or are no longer on board.
pub fn unmark<'a>(cache: &EdgeCache, hashes: impl IntoIterator<Item = &'a Hash32>) -> std::io::Result<()> {
    let dir = cache.damaged_dir();
    hashes.into_iter().try_for_each(|hash| cache.files().remove(&dir.join(hash.to_string())))
}
