//! The metadata and scene that a robot accepted, in two checksummed copies ([`Copies`]), under the cache's lock.

use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use slag_common::tuf::{Kept, sha256_hex};

use super::copies::{Copies, MAX_COPY_BYTES, Version};
use super::position::Position;
use crate::store::EdgeCache;
use crate::store::files::Stat;

/// Leaves room for the first line of a copy.
const MAX_CONTENT_BYTES: u64 = MAX_COPY_BYTES - 256;

/// Wait for another fetch: a service's and a command's may overlap.
const LOCK_TIMEOUT: Duration = Duration::from_secs(2);
const LOCK_PAUSE: Duration = Duration::from_millis(20);

#[derive(Debug, thiserror::Error)]
pub enum RecordsError {
    #[error("another fetch uses {path}; wait for it or end it", path = path.display())]
    Busy { path: PathBuf },
    #[error("another `serve --follow` or `fetch --watch` fills {path}; stop it, or give this one another --cache", path = path.display())]
    Followed { path: PathBuf },
    #[error("{path}: both copies of the record of trust are damaged ({what}): no store is believed, what is on board keeps answering; add the store's newest root with `slag-edge trust add --root FILE`", path = path.display())]
    Damaged { path: PathBuf, what: String },
    #[error(
        "the record of trust would take {len_bytes} bytes, the limit is {MAX_CONTENT_BYTES}; publish the scene under a shorter name"
    )]
    TooLong { len_bytes: u64 },
    #[error("{0}; check the cache's folder and its permissions")]
    Io(#[from] io::Error),
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LastFetch {
    pub from: String,
    pub at: Position,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Accepted {
    /// The scene; another one needs a request that names it. Absent before the first fetch.
    pub scene: Option<String>,
    /// SHA-256 of the newest root, hex.
    pub root_sha256: String,
    pub root_version: u64,
    /// When the newest timestamp says it was signed, seconds since 1970.
    pub signed_unix_secs: Option<u64>,
    pub expires_unix_secs: Option<u64>,
}

/// The content of the copies, as JSON.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Record {
    /// SHA-256 of the root that was trusted first, hex.
    pub first_root_sha256: Option<String>,
    /// What the client of the metadata keeps; absent before the first trust.
    pub kept: Option<Kept>,
    pub scene: Option<String>,
    pub last: Option<LastFetch>,
}

#[derive(Debug)]
pub struct Records {
    copies: Copies,
    version: Option<Version>,
    pub(super) record: Record,
    damage: Option<String>,
    _lock: File,
}

impl Records {
    /// Opens the records and repairs a damaged copy; holds the lock until dropped.
    pub fn open(cache: &EdgeCache) -> Result<Self, RecordsError> {
        let busy = || RecordsError::Busy { path: cache.dir().to_owned() };
        let lock = lock(cache.dir(), "lock")?.ok_or_else(busy)?;
        let copies = copies_of(cache);
        cache.create_dir(&copies.dir)?;
        let (found, damage) = match read(cache, &copies)? {
            Ok(found) => (found, None),
            Err(what) => (None, Some(what)),
        };
        let (mut version, record) = found.unzip();
        if let Some(version) = &mut version {
            copies.settle(cache.files(), version)?;
            if !version.is_twice {
                tracing::warn!(
                    "{}: one copy is damaged or outdated; it is written anew",
                    copies.dir.display()
                );
            }
            // One whole copy is enough for now; a full disk must not prevent a fetch.
            if let Err(e) = copies.heal(cache.files(), version) {
                tracing::warn!("one copy cannot be written anew: {e}");
            }
        }
        Ok(Self { copies, version, record: record.unwrap_or_default(), damage, _lock: lock })
    }

    pub fn damage(&self) -> Option<RecordsError> {
        let what = self.damage.clone()?;
        Some(RecordsError::Damaged { path: self.copies.dir.clone(), what })
    }

    /// Durably trusts a root, replacing former trust.
    pub fn trust(&mut self, cache: &EdgeCache, kept: Kept) -> Result<(), RecordsError> {
        let first_root_sha256 = Some(sha256_hex(kept.root.as_bytes()));
        self.write(cache, Record { first_root_sha256, kept: Some(kept), ..self.record.clone() })
    }

    pub fn keep(&mut self, cache: &EdgeCache, kept: &Kept) -> Result<(), RecordsError> {
        self.write(cache, Record { kept: Some(kept.clone()), ..self.record.clone() })
    }

    pub fn accept(&mut self, cache: &EdgeCache, last: &LastFetch, scene: &str) -> Result<(), RecordsError> {
        let (scene, last) = (Some(scene.to_owned()), Some(last.clone()));
        self.write(cache, Record { scene, last, ..self.record.clone() })
    }

    fn write(&mut self, cache: &EdgeCache, record: Record) -> Result<(), RecordsError> {
        let content = serde_json::to_vec(&record).map_err(io::Error::from)?;
        if self.version.as_ref().is_some_and(|version| version.is_twice && version.content == content) {
            return Ok(());
        }
        let len_bytes = content.len() as u64;
        if len_bytes > MAX_CONTENT_BYTES {
            return Err(RecordsError::TooLong { len_bytes });
        }
        let version = self.copies.write(cache.files(), self.version.as_ref(), content)?;
        (self.version, self.record, self.damage) = (Some(version), record, None);
        Ok(())
    }
}

/// Returns the accepted state, without the lock; `None` before the first trust.
pub fn accepted(cache: &EdgeCache) -> Result<Option<Accepted>, RecordsError> {
    let copies = copies_of(cache);
    let found = read(cache, &copies)?.map_err(|what| RecordsError::Damaged { path: copies.dir, what })?;
    let Some((_, Record { scene, kept, .. })) = found else { return Ok(None) };
    Ok(kept.and_then(|kept| {
        Some(Accepted {
            scene,
            root_sha256: sha256_hex(kept.root.as_bytes()),
            root_version: kept.root_version()?,
            signed_unix_secs: kept.signed_unix_secs(),
            expires_unix_secs: kept.expires_unix_secs(),
        })
    }))
}

/// Returns the position of the last fetch, without the lock.
pub fn last_position(cache: &EdgeCache) -> Option<Position> {
    let (_, record) = read(cache, &copies_of(cache)).ok()?.ok()??;
    record.last.map(|last| last.at)
}

/// Returns a value that changes whenever the records do.
pub(super) fn stamp(cache: &EdgeCache) -> [Option<Stat>; 2] {
    copies_of(cache).paths().map(|path| cache.files().stat(&path).ok().flatten())
}

fn copies_of(cache: &EdgeCache) -> Copies {
    Copies { dir: cache.dir().join("trust") }
}

/// Reads the newest record, if there is one; the inner error is damage.
fn read(cache: &EdgeCache, copies: &Copies) -> io::Result<Result<Option<(Version, Record)>, String>> {
    // A copy of another version of this program counts as damaged.
    let parse = |version: Version| match serde_json::from_slice(&version.content) {
        Ok(record) => Ok((version, record)),
        Err(e) => Err(e.to_string()),
    };
    Ok(copies.read(cache.files())?.and_then(|found| found.map(parse).transpose()))
}

/// Takes the place of a cache's one follower, which lasts as long as the file is open: two would undo each other's
/// fetches. `None` where nothing can be written: fetches say so.
pub fn only_follower(cache: &EdgeCache) -> Result<Option<File>, RecordsError> {
    match lock(cache.dir(), "follower") {
        Ok(Some(place)) => Ok(Some(place)),
        Ok(None) => Err(RecordsError::Followed { path: cache.dir().to_owned() }),
        Err(_) => Ok(None),
    }
}

/// Takes a lock of the cache, which lasts as long as the file is open; `None`: another program has it.
fn lock(dir: &Path, name: &str) -> io::Result<Option<File>> {
    let path = dir.join(name);
    fs_err::create_dir_all(dir)?;
    // Also opened to read: opening a pipe only to write would wait for a reader.
    let file = fs_err::OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path)?;
    let file = file.into_parts().0;
    let start = Instant::now();
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(Some(file)),
            Err(TryLockError::WouldBlock) if start.elapsed() > LOCK_TIMEOUT => return Ok(None),
            Err(TryLockError::WouldBlock) => std::thread::sleep(LOCK_PAUSE),
            Err(TryLockError::Error(e)) => {
                return Err(io::Error::new(e.kind(), format!("locking {}: {e}", path.display())));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use slag_common::tuf::{MAX_ROOT_BYTES, MAX_SNAPSHOT_BYTES, MAX_TIMESTAMP_BYTES};

    use super::*;

    #[test]
    fn a_cache_has_one_follower() {
        let dir = tempfile::tempdir().expect("temporary folder");
        let cache = EdgeCache::open(dir.path());
        let place = only_follower(&cache).expect("free");
        let second = only_follower(&cache).expect_err("taken").to_string();
        assert!(place.is_some() && second.contains("--cache"), "{second}");
        drop(place);
        assert!(only_follower(&cache).expect("free again").is_some());
    }

    /// Quotes are the longest: JSON within JSON doubles them.
    #[test]
    fn the_longest_metadata_is_kept() {
        let quotes = |max_bytes: u64| "\"".repeat(max_bytes as usize);
        let kept = Kept {
            root: quotes(MAX_ROOT_BYTES),
            timestamp: Some(quotes(MAX_TIMESTAMP_BYTES)),
            snapshot: Some(quotes(MAX_SNAPSHOT_BYTES)),
            targets: None,
        };
        let dir = tempfile::tempdir().expect("temporary folder");
        let cache = EdgeCache::open(dir.path());
        Records::open(&cache).expect("opens").keep(&cache, &kept).expect("fits");
        assert_eq!(Records::open(&cache).expect("opens").record.kept, Some(kept));
    }
}
