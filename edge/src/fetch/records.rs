//! What a robot believes: the key and scene that it accepted, the keys that were replaced, and the highest
//! generations seen. Two checksummed copies on the cache's own storage ([`Copies`]); the lock of the cache
//! ensures one fetch at a time.

use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::Manifest;

use super::copies::{Copies, Found, MAX_COPY_BYTES, Version};
use super::lock::Lock;
use super::position::Position;
use crate::store::EdgeCache;

/// Room for the first line of a copy.
const MAX_CONTENT_BYTES: u64 = MAX_COPY_BYTES - 256;

/// Reasons for which the records cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RecordsError {
    /// Another fetch holds the lock.
    #[error("another fetch uses {path}; wait for it or end it", path = path.display())]
    Busy {
        /// The cache.
        path: PathBuf,
    },
    /// Both copies are damaged, and no key is given.
    #[error("{path}: both copies of the record of accepted keys are damaged ({what}), so that no key is accepted; what is on board keeps answering. Give the store's key once (`fetch --key HEX`, as `slag-encoder keys show` prints it): the record is then written anew", path = path.display())]
    Damaged {
        /// The copies' folder.
        path: PathBuf,
        /// The fault of one copy.
        what: String,
    },
    /// The record would be too long to be read again.
    #[error(
        "the record of accepted keys and scenes would take {len_bytes} bytes, the limit is {MAX_CONTENT_BYTES}; publish the scene under a shorter name"
    )]
    TooLong {
        /// Its length.
        len_bytes: u64,
    },
    /// The file system's error, with the path.
    #[error("{0}; check the cache's folder and its permissions")]
    Io(#[from] io::Error),
}

/// The request of the last fetch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LastFetch {
    /// The store's address.
    pub from: String,
    /// The position.
    pub at: Position,
}

/// What a robot accepted.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Accepted {
    /// The scene; another one needs a request that names it.
    pub scene: String,
    /// The key.
    pub key: Hash32,
    /// The successor that the key names.
    pub next_key: Option<Hash32>,
}

/// The highest generation seen of a scene signed by a key.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Floor {
    key: Hash32,
    scene: String,
    generation: u64,
}

/// The content of the copies, as JSON.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Record {
    scene: Option<String>,
    key: Option<Hash32>,
    next_key: Option<Hash32>,
    /// Keys that are no longer accepted, and their successors.
    successors: BTreeMap<Hash32, Hash32>,
    generations: Vec<Floor>,
    last: Option<LastFetch>,
}

/// The open records.
#[derive(Debug)]
pub struct Records {
    copies: Copies,
    version: Option<Version>,
    record: Record,
    /// The fault, if both copies are damaged.
    damage: Option<String>,
    _lock: Lock,
}

impl Records {
    /// Opens the records and mends a damaged copy; holds the lock until dropped.
    ///
    /// # Errors
    /// [`RecordsError`], as for every operation here.
    pub fn open(cache: &EdgeCache) -> Result<Self, RecordsError> {
        let busy = || RecordsError::Busy { path: cache.dir().to_owned() };
        let lock = Lock::take(cache.dir())?.ok_or_else(busy)?;
        let copies = copies_of(cache);
        cache.files().create_dir(copies.dir())?;
        let (mut version, record, damage) = match read(cache, &copies)? {
            Read::Nothing => (None, Record::default(), None),
            Read::Record(version, record) => (Some(version), *record, None),
            Read::Damaged(what) => (None, Record::default(), Some(what)),
        };
        if let Some(version) = &mut version {
            copies.settle(cache.files(), version)?;
            if !version.is_twice {
                tracing::warn!(
                    "{}: one copy is damaged or outdated; it is written anew",
                    copies.dir().display()
                );
            }
            // The whole copy is enough for now; a full disk must not keep a robot from fetching.
            if let Err(e) = copies.heal(cache.files(), version) {
                tracing::warn!("one copy cannot be written anew: {e}");
            }
        }
        Ok(Self { copies, version, record, damage, _lock: lock })
    }

    /// Returns the error of damaged records, if both copies are damaged.
    pub fn damage(&self) -> Option<RecordsError> {
        let what = self.damage.clone()?;
        Some(RecordsError::Damaged { path: self.copies.dir().to_owned(), what })
    }

    /// Returns the request of the last fetch.
    pub fn last(&self) -> Option<&LastFetch> {
        self.record.last.as_ref()
    }

    /// Returns the scene accepted.
    pub fn scene(&self) -> Option<&str> {
        self.record.scene.as_deref()
    }

    /// Returns the accepted key and its named successor.
    pub fn keys(&self) -> Option<(Hash32, Option<Hash32>)> {
        self.record.key.map(|key| (key, self.record.next_key))
    }

    /// Returns the key that replaced a key, or the key itself.
    pub fn successor(&self, mut key: Hash32) -> Hash32 {
        // A chain is never longer than the list; a circle would be.
        for _ in 0..self.record.successors.len() {
            match self.record.successors.get(&key) {
                Some(successor) => key = *successor,
                None => break,
            }
        }
        key
    }

    /// Returns the highest generation seen of a scene signed by a key.
    pub fn highest_generation(&self, key: Hash32, scene: &str) -> Option<u64> {
        let of_key = self.record.generations.iter().filter(|floor| floor.key == key && floor.scene == scene);
        of_key.map(|floor| floor.generation).max()
    }

    /// Durably records an accepted manifest and the request for it. A key that its key replaces is no longer
    /// accepted.
    pub fn accept(
        &mut self,
        cache: &EdgeCache,
        last: &LastFetch,
        manifest: &Manifest,
        key: Hash32,
        replaced: Option<Hash32>,
    ) -> Result<(), RecordsError> {
        let mut record = self.record.clone();
        record.scene = Some(manifest.scene.clone());
        (record.key, record.next_key) = (Some(key), manifest.next_key);
        record.last = Some(last.clone());
        record.successors.remove(&key);
        if let Some(old) = replaced.filter(|old| *old != key) {
            record.successors.insert(old, key);
            // A successor continues the generation counts.
            record.generations.iter_mut().filter(|f| f.key == old).for_each(|floor| floor.key = key);
        }
        let scene = manifest.scene.clone();
        record.generations.push(Floor { key, scene, generation: manifest.generation });
        record.generations = highest(record.generations);
        let is_same = self.version.as_ref().is_some_and(|version| version.is_twice);
        if is_same && record == self.record {
            return Ok(());
        }
        let content = serde_json::to_vec(&record).map_err(io::Error::from)?;
        let len_bytes = content.len() as u64;
        if len_bytes > MAX_CONTENT_BYTES {
            return Err(RecordsError::TooLong { len_bytes });
        }
        let version = self.copies.write(cache.files(), self.version.as_ref(), content)?;
        (self.version, self.record, self.damage) = (Some(version), record, None);
        Ok(())
    }
}

/// Returns what a robot accepted, without the lock; `None` before the first fetch, or if the records are
/// damaged.
pub fn accepted(cache: &EdgeCache) -> Option<Accepted> {
    match read(cache, &copies_of(cache)) {
        Ok(Read::Record(_, record)) => {
            let Record { scene, key, next_key, .. } = *record;
            Some(Accepted { scene: scene?, key: key?, next_key })
        }
        _ => None,
    }
}

fn copies_of(cache: &EdgeCache) -> Copies {
    Copies::new(cache.dir().join("trust"))
}

enum Read {
    Nothing,
    Record(Version, Box<Record>),
    Damaged(String),
}

fn read(cache: &EdgeCache, copies: &Copies) -> io::Result<Read> {
    Ok(match copies.read(cache.files())? {
        Found::Nothing => Read::Nothing,
        Found::Damaged(what) => Read::Damaged(what),
        // A whole copy of another version of this program: as damaged, no key of it counts.
        Found::Record(version) => match serde_json::from_slice(&version.content) {
            Ok(record) => Read::Record(version, Box::new(record)),
            Err(e) => Read::Damaged(e.to_string()),
        },
    })
}

/// Keeps the highest generation of each key and scene.
fn highest(mut floors: Vec<Floor>) -> Vec<Floor> {
    floors.sort_by(|a, b| (a.key, &a.scene, b.generation).cmp(&(b.key, &b.scene, a.generation)));
    floors.dedup_by(|later, first| later.key == first.key && later.scene == first.scene);
    floors
}
