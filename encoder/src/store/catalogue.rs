//! The catalogue of a store, in sled: what was published.
//!
//! | tree | key | value, JSON |
//! |---|---|---|
//! | `generations` | number, big-endian | [`GenerationRecord`], of every generation ever published |
//!
//! `encode` and `push` keep their state in trees of their own. A writer holds the database while it writes; readers
//! read a copy. Except for the history it repeats what files say, so a damaged one is set aside and rebuilt from the
//! files.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::Manifest;

use super::StoreError;

/// sled keeps whole pages in memory; the records are small.
const CACHE_BYTES: u64 = 16 << 20;
const LOCK_PAUSE: Duration = Duration::from_millis(20);
const GENERATIONS: &str = "generations";

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct GenerationRecord {
    pub(crate) scene: String,
    pub(crate) generation: u64,
    pub(crate) manifest_hash: Hash32,
    /// When it was made, seconds since 1970.
    pub(crate) created_unix_secs: u64,
    pub(crate) n_cells: usize,
    pub(crate) n_gaussians: u64,
}

enum Fault {
    /// By another process.
    Held,
    Damaged(String),
    Failed(sled::Error),
}

impl From<sled::Error> for Fault {
    fn from(e: sled::Error) -> Self {
        use std::io::ErrorKind as Kind;

        match e {
            // sled has no error kind for this.
            sled::Error::Io(e) if e.to_string().contains("could not acquire lock") => Self::Held,
            sled::Error::Io(ref io) if !matches!(io.kind(), Kind::InvalidData | Kind::UnexpectedEof) => {
                Self::Failed(e)
            }
            e => Self::Damaged(e.to_string()),
        }
    }
}

/// Catches panics of sled, which some damage causes.
fn guarded<T>(work: impl FnOnce() -> Result<T, Fault>) -> Result<T, Fault> {
    catch_unwind(AssertUnwindSafe(work))
        .unwrap_or_else(|_| Err(Fault::Damaged("the database panicked".into())))
}

fn records_error(path: &Path, fault: Fault) -> StoreError {
    let cause = match fault {
        Fault::Failed(cause) => cause,
        Fault::Damaged(what) => sled::Error::ReportableBug(what),
        Fault::Held => sled::Error::ReportableBug("it is held twice".into()),
    };
    StoreError::Records { path: path.to_owned(), cause }
}

fn decode<T: for<'a> Deserialize<'a>>(bytes: &[u8]) -> Result<T, Fault> {
    serde_json::from_slice(bytes).map_err(|e| Fault::Damaged(e.to_string()))
}

#[derive(Debug)]
pub(crate) struct Catalogue {
    path: PathBuf,
    db: sled::Db,
    generations: sled::Tree,
}

impl Catalogue {
    /// Opens a store's database for writing; a damaged one is renamed to `db.damaged` and replaced by an empty one.
    /// Waits up to `patience` for another writer.
    pub(crate) fn open(store: &Path, patience: Duration) -> Result<Self, StoreError> {
        if SystemTime::now() < UNIX_EPOCH {
            // sled panics then.
            return Err(StoreError::Failed("this machine's clock says a time before 1970; set it".into()));
        }
        let path = store.join("db");
        let refused = |fault| match fault {
            Fault::Held => StoreError::Locked { store: store.to_owned() },
            fault => records_error(&path, fault),
        };
        match Self::load(&path, patience) {
            Err(Fault::Damaged(what)) => {
                let aside = store.join("db.damaged");
                tracing::warn!(
                    "{}: {what}; it is set aside and made anew from the store's files",
                    path.display()
                );
                if aside.exists() {
                    fs_err::remove_dir_all(&aside)?;
                }
                fs_err::rename(&path, &aside)?;
                Self::load(&path, patience).map_err(refused)
            }
            opened => opened.map_err(refused),
        }
    }

    /// Reads the whole database once, so that damage shows here and not later.
    fn load(path: &Path, patience: Duration) -> Result<Self, Fault> {
        let config = sled::Config::new().path(path).cache_capacity(CACHE_BYTES);
        let start = Instant::now();
        loop {
            let opened = guarded(|| {
                let db = config.open()?;
                let generations = db.open_tree(GENERATIONS)?;
                for name in db.tree_names() {
                    db.open_tree(name)?.iter().try_for_each(|record| record.map(drop))?;
                }
                let catalogue = Self { path: path.to_owned(), db, generations };
                catalogue.history()?;
                Ok(catalogue)
            });
            match opened {
                Err(Fault::Held) if start.elapsed() <= patience => std::thread::sleep(LOCK_PAUSE),
                opened => return opened,
            }
        }
    }

    /// For the state of jobs and pushes.
    pub(crate) fn db(&self) -> &sled::Db {
        &self.db
    }

    fn history(&self) -> Result<Vec<GenerationRecord>, Fault> {
        self.generations.iter().values().map(|value| decode(&value?)).collect()
    }

    /// All generations ever published, oldest first.
    pub(crate) fn generations(&self) -> Result<Vec<GenerationRecord>, StoreError> {
        self.history().map_err(|fault| records_error(&self.path, fault))
    }

    pub(crate) fn last_generation(&self) -> Result<Option<u64>, StoreError> {
        let last = self.generations.last().map_err(|e| records_error(&self.path, e.into()))?;
        Ok(last.and_then(|(key, _)| Some(u64::from_be_bytes(key.as_ref().try_into().ok()?))))
    }

    pub(crate) fn record(&self, manifest: &Manifest, manifest_hash: Hash32) -> Result<(), StoreError> {
        let write = || -> Result<(), Fault> {
            let key = manifest.generation.to_be_bytes();
            let record = GenerationRecord {
                scene: manifest.scene.clone(),
                generation: manifest.generation,
                manifest_hash,
                created_unix_secs: manifest.created_unix_secs,
                n_cells: manifest.cells.len(),
                n_gaussians: manifest.n_gaussians,
            };
            let held =
                self.generations.get(key)?.map(|bytes| decode::<GenerationRecord>(&bytes)).transpose()?;
            if held.as_ref() != Some(&record) {
                self.generations.insert(key, serde_json::to_vec(&record).expect("a record is JSON"))?;
            }
            self.db.flush().map(drop).map_err(Fault::from)
        };
        guarded(write).map_err(|fault| records_error(&self.path, fault))
    }
}

/// A catalogue read from a copy: neither the store nor its lock is touched, so a writer may be at work.
#[derive(Debug)]
pub(crate) struct CatalogueCopy {
    pub(crate) catalogue: Catalogue,
    _folder: tempfile::TempDir,
}

impl CatalogueCopy {
    /// Copies a store's catalogue to a temporary folder under `scratch`. `None` if the store has no catalogue, or the
    /// copy is damaged because a writer changed it meanwhile.
    pub(crate) fn of(store: &Path, scratch: &Path) -> Result<Option<Self>, StoreError> {
        let db = store.join("db");
        if !db.is_dir() {
            return Ok(None);
        }
        let folder = tempfile::tempdir_in(scratch)?;
        // sled keeps all but large values in files of this one folder, and the records are small.
        for entry in fs_err::read_dir(db)? {
            let path = entry?.path();
            if let (true, Some(name)) = (path.is_file(), path.file_name()) {
                fs_err::copy(&path, folder.path().join(name))?;
            }
        }
        let loaded = Catalogue::load(folder.path(), Duration::ZERO).ok();
        Ok(loaded.map(|catalogue| Self { catalogue, _folder: folder }))
    }
}

#[cfg(test)]
mod tests;
