//! Records of earlier fetches, in sled. The database's lock also ensures one fetch at a time.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::Manifest;

use super::position::Position;

/// sled's page cache; the records take a few kilobytes.
const CACHE_BYTES: u64 = 1 << 20;
/// A fetch that just ended may hold the lock a moment longer: sled releases it on a thread of its own.
const LOCK_TIMEOUT: Duration = Duration::from_secs(2);
const LOCK_PAUSE: Duration = Duration::from_millis(20);

/// Reasons for which the records cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RecordsError {
    /// Another fetch holds the lock.
    #[error("another fetch uses {path}; wait for it or end it", path = path.display())]
    Busy {
        /// The records' folder.
        path: PathBuf,
    },
    /// The database failed.
    #[error("{path}: {source}; check disk space and permissions, or delete the folder and fetch again with --from URL", path = path.display())]
    Database {
        /// The records' folder.
        path: PathBuf,
        /// Its error.
        source: sled::Error,
    },
    /// A record is damaged.
    #[error("{path}: record {record:?} is damaged; delete the folder and fetch again with --from URL", path = path.display())]
    Damaged {
        /// The records' folder.
        path: PathBuf,
        /// The record.
        record: &'static str,
    },
}

/// The request of the last fetch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LastFetch {
    /// The store's address.
    pub from: String,
    /// The position.
    pub at: Position,
}

/// The open records.
pub struct Records {
    path: PathBuf,
    db: sled::Db,
    generations: sled::Tree,
    used: sled::Tree,
    /// Keys that are no longer accepted, and their successors.
    successors: sled::Tree,
}

/// Longest chain of key changes; a longer one is damage.
const MAX_SUCCESSORS: usize = 1000;

impl Records {
    /// Opens or creates the records; holds the lock until dropped.
    ///
    /// # Errors
    /// [`RecordsError`], as for every operation here.
    pub fn open(path: &Path) -> Result<Self, RecordsError> {
        let config = sled::Config::new().path(path).cache_capacity(CACHE_BYTES).flush_every_ms(None);
        let start = Instant::now();
        loop {
            let opened = config.open().and_then(|db| {
                let open = |name| db.open_tree(name);
                let (generations, used, successors) =
                    (open("generations")?, open("used")?, open("successors")?);
                Ok(Self { path: path.to_owned(), db, generations, used, successors })
            });
            let path = path.to_owned();
            match opened {
                Ok(records) => return Ok(records),
                // sled has no error variant for this.
                Err(sled::Error::Io(e)) if e.to_string().contains("could not acquire lock") => {
                    if start.elapsed() > LOCK_TIMEOUT {
                        return Err(RecordsError::Busy { path });
                    }
                    std::thread::sleep(LOCK_PAUSE);
                }
                Err(source) => return Err(RecordsError::Database { path, source }),
            }
        }
    }

    /// Returns the request of the last fetch.
    pub fn last(&self) -> Result<Option<LastFetch>, RecordsError> {
        let bytes = self.db.get("last").map_err(|e| self.database(e))?;
        bytes.map(|bytes| serde_json::from_slice(&bytes).map_err(|_| self.damaged("last"))).transpose()
    }

    /// Returns the accepted key and its named successor.
    pub fn keys(&self) -> Result<Option<(Hash32, Option<Hash32>)>, RecordsError> {
        let Some(key) = self.hash(&self.db, b"key", "key")? else { return Ok(None) };
        Ok(Some((key, self.hash(&self.db, b"next_key", "next_key")?)))
    }

    /// Returns the key that replaced a key, or the key itself.
    pub fn successor(&self, mut key: Hash32) -> Result<Hash32, RecordsError> {
        for _ in 0..MAX_SUCCESSORS {
            match self.hash(&self.successors, &key.0, "successors")? {
                Some(successor) => key = successor,
                None => return Ok(key),
            }
        }
        Err(self.damaged("successors"))
    }

    /// Returns the highest generation seen of a scene signed by a key.
    pub fn highest_generation(&self, key: Hash32, scene: &str) -> Result<Option<u64>, RecordsError> {
        self.number(&self.generations, &generation_name(key, scene), "generations")
    }

    /// Returns the number of the last fetch that needed a shard; 0 if unknown.
    pub fn last_used(&self, shard: Hash32) -> Result<u64, RecordsError> {
        Ok(self.number(&self.used, &shard.0, "used")?.unwrap_or(0))
    }

    /// Durably records an accepted manifest and the request for it. Keys that its key replaces are no longer
    /// accepted.
    pub fn accept(
        &self,
        last: &LastFetch,
        manifest: &Manifest,
        key: Hash32,
        replaced: &[Hash32],
    ) -> Result<(), RecordsError> {
        let last = serde_json::to_vec(last).map_err(|_| self.damaged("last"))?;
        // In this order: whatever part survives a power cut, the old key is not accepted once the new one is,
        // and the new one never for an older generation than was seen.
        let write = || {
            let generation = manifest.generation.to_le_bytes();
            self.generations.insert(generation_name(key, &manifest.scene), &generation)?;
            for old in replaced {
                self.successors.insert(old.0, &key.0)?;
            }
            self.successors.remove(key.0)?;
            let mut batch = sled::Batch::default();
            batch.insert("last", last);
            batch.insert("key", &key.0);
            match manifest.next_key {
                Some(next) => batch.insert("next_key", &next.0),
                None => batch.remove("next_key"),
            }
            self.db.apply_batch(batch)?;
            self.db.flush()
        };
        write().map(drop).map_err(|e| self.database(e))
    }

    /// Records the shards that a fetch needed and those it freed.
    pub fn finish(
        &self,
        needed: impl Iterator<Item = Hash32>,
        freed: impl Iterator<Item = Hash32>,
    ) -> Result<(), RecordsError> {
        let count = self.number(&self.db, b"fetches", "fetches")?.unwrap_or(0).saturating_add(1);
        let write = || {
            self.db.insert("fetches", &count.to_le_bytes())?;
            for hash in needed {
                self.used.insert(hash.0, &count.to_le_bytes())?;
            }
            for hash in freed {
                self.used.remove(hash.0)?;
            }
            self.db.flush()
        };
        write().map(drop).map_err(|e| self.database(e))
    }

    fn hash(
        &self,
        tree: &sled::Tree,
        name: &[u8],
        record: &'static str,
    ) -> Result<Option<Hash32>, RecordsError> {
        let bytes = tree.get(name).map_err(|e| self.database(e))?;
        bytes.map(|b| b.as_ref().try_into().map(Hash32).map_err(|_| self.damaged(record))).transpose()
    }

    fn number(
        &self,
        tree: &sled::Tree,
        name: &[u8],
        record: &'static str,
    ) -> Result<Option<u64>, RecordsError> {
        let bytes = tree.get(name).map_err(|e| self.database(e))?;
        bytes
            .map(|b| b.as_ref().try_into().map(u64::from_le_bytes).map_err(|_| self.damaged(record)))
            .transpose()
    }

    fn database(&self, source: sled::Error) -> RecordsError {
        RecordsError::Database { path: self.path.clone(), source }
    }

    fn damaged(&self, record: &'static str) -> RecordsError {
        RecordsError::Damaged { path: self.path.clone(), record }
    }
}

fn generation_name(key: Hash32, scene: &str) -> Vec<u8> {
    [&key.0, scene.as_bytes()].concat()
}
