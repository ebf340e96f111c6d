//! The catalogue of a store, in sled: what was published, and of which cells.
//!
//! | tree | key | value, JSON |
//! |---|---|---|
//! | `generations` | number, big-endian | [`GenerationRecord`], of every generation ever published |
//! | `cells` | hash of a manifest, id of a cell | the cell's record: box, shards, hashes; of the manifests that the store has |
//!
//! `encode` and `push` keep the state of their work in trees of their own. A writer holds the database for as long as it
//! writes; readers read a copy. It repeats what files say, but for the history, so a damaged one is set aside and made
//! anew from the files.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::{CellRecord, Manifest};

use super::error::StoreError;

/// sled keeps whole pages in memory; the records are small.
const CACHE_BYTES: u64 = 16 << 20;
const LOCK_PAUSE: Duration = Duration::from_millis(20);
const GENERATIONS: &str = "generations";
const CELLS: &str = "cells";

/// What the catalogue says of a generation.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct GenerationRecord {
    /// Name of the scene.
    pub(crate) scene: String,
    /// Its number.
    pub(crate) generation: u64,
    pub(crate) manifest_hash: Hash32,
    /// When it was made, seconds since 1970.
    pub(crate) created_unix_secs: u64,
    pub(crate) n_cells: usize,
    /// Number of Gaussians in them.
    pub(crate) n_gaussians: u64,
}

impl GenerationRecord {
    fn of(manifest: &Manifest, manifest_hash: Hash32) -> Self {
        Self {
            scene: manifest.scene.clone(),
            generation: manifest.generation,
            manifest_hash,
            created_unix_secs: manifest.created_unix_secs,
            n_cells: manifest.cells.len(),
            n_gaussians: manifest.n_gaussians,
        }
    }
}

/// Why a database cannot be used.
enum Fault {
    /// Another process holds it.
    Held,
    /// Its content is damaged.
    Damaged(String),
    /// The file system's.
    Failed(sled::Error),
}

impl From<sled::Error> for Fault {
    fn from(e: sled::Error) -> Self {
        use std::io::ErrorKind as Kind;

        match e {
            // sled has no error kind of its own for this.
            sled::Error::Io(e) if e.to_string().contains("could not acquire lock") => Self::Held,
            sled::Error::Io(ref io) if !matches!(io.kind(), Kind::InvalidData | Kind::UnexpectedEof) => {
                Self::Failed(e)
            }
            e => Self::Damaged(e.to_string()),
        }
    }
}

/// Runs work on a database that may be damaged: sled panics on some damage.
fn guarded<T>(work: impl FnOnce() -> Result<T, Fault>) -> Result<T, Fault> {
    catch_unwind(AssertUnwindSafe(work))
        .unwrap_or_else(|_| Err(Fault::Damaged("the database panicked".into())))
}

fn decode<T: for<'a> Deserialize<'a>>(bytes: &[u8]) -> Result<T, Fault> {
    serde_json::from_slice(bytes).map_err(|e| Fault::Damaged(e.to_string()))
}

fn cell_key(manifest_hash: Hash32, cell_id: u32) -> Vec<u8> {
    [&manifest_hash.0[..], &cell_id.to_be_bytes()].concat()
}

/// The open catalogue.
#[derive(Debug)]
pub(crate) struct Catalogue {
    path: PathBuf,
    db: sled::Db,
    generations: sled::Tree,
    cells: sled::Tree,
}

impl Catalogue {
    /// Opens the database of a store for writing; a damaged one is renamed to `db.damaged`, and an empty one takes its
    /// place. Waits up to `patience` for another writer.
    pub(crate) fn open(store: &Path, patience: Duration) -> Result<Self, StoreError> {
        let path = store.join("db");
        let refused = |fault| match fault {
            Fault::Held => StoreError::Locked { store: store.to_owned() },
            Fault::Damaged(what) => {
                StoreError::Records { path: path.clone(), cause: sled::Error::ReportableBug(what) }
            }
            Fault::Failed(cause) => StoreError::Records { path: path.clone(), cause },
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

    /// Opens the database and reads all of it once, so that damage shows here and not later.
    fn load(path: &Path, patience: Duration) -> Result<Self, Fault> {
        let config = sled::Config::new().path(path).cache_capacity(CACHE_BYTES);
        let start = Instant::now();
        loop {
            let opened = guarded(|| {
                let db = config.open()?;
                let (generations, cells) = (db.open_tree(GENERATIONS)?, db.open_tree(CELLS)?);
                for name in db.tree_names() {
                    db.open_tree(name)?.iter().try_for_each(|record| record.map(drop))?;
                }
                let catalogue = Self { path: path.to_owned(), db, generations, cells };
                catalogue.history()?;
                for record in &catalogue.cells {
                    decode::<CellRecord>(&record?.1)?;
                }
                Ok(catalogue)
            });
            match opened {
                Err(Fault::Held) if start.elapsed() <= patience => std::thread::sleep(LOCK_PAUSE),
                opened => return opened,
            }
        }
    }

    /// Returns the database, for the state of jobs and pushes.
    pub(crate) fn db(&self) -> &sled::Db {
        &self.db
    }

    fn error(&self, fault: Fault) -> StoreError {
        let cause = match fault {
            Fault::Failed(cause) => cause,
            Fault::Damaged(what) => sled::Error::ReportableBug(what),
            Fault::Held => sled::Error::ReportableBug("it is held twice".into()),
        };
        StoreError::Records { path: self.path.clone(), cause }
    }

    fn history(&self) -> Result<Vec<GenerationRecord>, Fault> {
        self.generations.iter().values().map(|value| decode(&value?)).collect()
    }

    fn cells_of(&self, manifest_hash: Hash32) -> Result<Vec<CellRecord>, Fault> {
        self.cells.scan_prefix(manifest_hash.0).values().map(|value| decode(&value?)).collect()
    }

    /// Returns all generations ever published, the oldest first.
    pub(crate) fn generations(&self) -> Result<Vec<GenerationRecord>, StoreError> {
        self.history().map_err(|fault| self.error(fault))
    }

    /// Returns the cells of a manifest, in order of their ids.
    pub(crate) fn cells(&self, manifest_hash: Hash32) -> Result<Vec<CellRecord>, StoreError> {
        self.cells_of(manifest_hash).map_err(|fault| self.error(fault))
    }

    /// Returns the highest generation published.
    pub(crate) fn last_generation(&self) -> Result<Option<u64>, StoreError> {
        let last = self.generations.last().map_err(|e| self.error(e.into()))?;
        Ok(last.and_then(|(key, _)| Some(u64::from_be_bytes(key.as_ref().try_into().ok()?))))
    }

    /// Makes the catalogue say what a manifest says, unless it does.
    pub(crate) fn record(&self, manifest: &Manifest, manifest_hash: Hash32) -> Result<(), StoreError> {
        let write = || -> Result<(), Fault> {
            let key = manifest.generation.to_be_bytes();
            let record = GenerationRecord::of(manifest, manifest_hash);
            let held =
                self.generations.get(key)?.map(|bytes| decode::<GenerationRecord>(&bytes)).transpose()?;
            if held.as_ref() != Some(&record) {
                self.generations.insert(key, serde_json::to_vec(&record).expect("a record is JSON"))?;
            }
            if self.cells_of(manifest_hash)? != manifest.cells {
                let mut batch = sled::Batch::default();
                for key in self.cells.scan_prefix(manifest_hash.0).keys() {
                    batch.remove(key?);
                }
                for cell in &manifest.cells {
                    let record = serde_json::to_vec(cell).expect("a cell record is JSON");
                    batch.insert(cell_key(manifest_hash, cell.cell_id), record);
                }
                self.cells.apply_batch(batch)?;
            }
            self.db.flush().map(drop).map_err(Fault::from)
        };
        guarded(write).map_err(|fault| self.error(fault))
    }

    /// Forgets the cells of other manifests than these.
    pub(crate) fn keep_cells_of(&self, manifests: &[Hash32]) -> Result<(), StoreError> {
        let forget = || -> Result<(), Fault> {
            let mut batch = sled::Batch::default();
            for key in self.cells.iter().keys() {
                let key = key?;
                if !manifests.iter().any(|manifest| key.starts_with(&manifest.0)) {
                    batch.remove(key);
                }
            }
            self.cells.apply_batch(batch)?;
            self.db.flush().map(drop).map_err(Fault::from)
        };
        guarded(forget).map_err(|fault| self.error(fault))
    }
}

/// What a catalogue says, read from a copy: neither the store nor its lock is touched, so a writer may be at work.
#[derive(Debug)]
pub(crate) struct CatalogueCopy {
    catalogue: Catalogue,
    _folder: tempfile::TempDir,
}

impl CatalogueCopy {
    /// Copies a store's catalogue to a folder under `scratch`, which goes with it. `None` if the store has no catalogue, or
    /// the copy is damaged: a writer may have changed it meanwhile.
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

    /// Returns the copied database, for the state of jobs.
    pub(crate) fn db(&self) -> &sled::Db {
        self.catalogue.db()
    }

    /// Returns all generations ever published, the oldest first.
    pub(crate) fn generations(&self) -> Result<Vec<GenerationRecord>, StoreError> {
        self.catalogue.generations()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::tests::manifest;
    use crate::store::{Extras, Store, StoreReader};

    fn files_of(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs_err::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() { files_of(&path, found) } else { found.push(path) }
        }
    }

    /// Every file of the database overwritten, cut or removed: the store opens, knows its cells, counts on from its
    /// manifest, and readers are told the truth meanwhile.
    #[test]
    fn a_damaged_catalogue_is_made_anew_from_the_files() {
        let damages: [fn(&Path); 4] = [
            |path| fs_err::write(path, vec![0xA5; 4096]).expect("writes"),
            |path| fs_err::write(path, b"").expect("writes"),
            |path| fs_err::remove_file(path).expect("there"),
            |path| {
                let mut bytes = fs_err::read(path).expect("there");
                bytes.iter_mut().step_by(97).for_each(|byte| *byte ^= 0x41);
                fs_err::write(path, bytes).expect("writes");
            },
        ];
        for (number, damage) in damages.iter().enumerate() {
            let [dir, scratch] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
            let store = Store::create_or_open(dir.path()).expect("opens");
            let shards: Vec<_> =
                ["a", "b"].map(|text| store.put_bytes(text.as_bytes()).expect("room")).into();
            store.publish(&manifest(6, &shards[..1]), &Extras::new()).expect("publishes");
            store.publish(&manifest(7, &shards), &Extras::new()).expect("publishes");
            drop(store);
            let mut files = Vec::new();
            files_of(&dir.path().join("db"), &mut files);
            files.iter().for_each(|path| damage(path));
            // A reader never believes a damaged catalogue.
            let seen = CatalogueCopy::of(dir.path(), scratch.path()).expect("copies");
            let generations = seen.map(|copy| copy.generations().expect("reads")).unwrap_or_default();
            assert!(generations.iter().all(|record| record.n_cells <= 2), "damage {number}");
            let store = Store::create_or_open(dir.path()).unwrap_or_else(|e| panic!("damage {number}: {e}"));
            assert_eq!(store.cells().expect("reads"), manifest(7, &shards).cells, "damage {number}");
            assert_eq!(store.next_generation().expect("reads"), 8, "damage {number}");
            let generations = store.generations().expect("reads");
            let numbers: Vec<u64> = generations.iter().map(|record| record.generation).collect();
            assert_eq!(numbers, [6, 7], "damage {number}");
            store.publish(&manifest(8, &shards), &Extras::new()).expect("publishes");
            assert!(StoreReader::open(dir.path()).expect("whole").listing().verify(|| {}).bad.is_empty());
        }
    }

    #[test]
    fn the_catalogue_keeps_the_history() {
        let dir = tempfile::tempdir().expect("a folder");
        let store = Store::create_or_open(dir.path()).expect("opens");
        let shards: Vec<_> =
            ["a", "b", "c"].map(|text| store.put_bytes(text.as_bytes()).expect("room")).into();
        for generation in 1..=3 {
            let manifest = manifest(generation, &shards[..generation as usize]);
            store.publish(&manifest, &Extras::new()).expect("publishes");
        }
        store.prune().expect("prunes");
        drop(store);
        let store = Store::create_or_open(dir.path()).expect("opens");
        let generations = store.generations().expect("reads");
        let seen: Vec<(u64, usize)> =
            generations.iter().map(|record| (record.generation, record.n_cells)).collect();
        assert_eq!(seen, [(1, 1), (2, 2), (3, 3)]);
        assert_eq!(store.cells().expect("reads"), manifest(3, &shards).cells);
        let of = |generation: usize| {
            let manifest = manifest(generation as u64, &shards[..generation]);
            store.catalogue().cells(Hash32::of(&manifest.to_bytes())).expect("reads").len()
        };
        assert_eq!([of(1), of(2), of(3)], [0, 2, 3], "cells are forgotten with their objects");
    }

    fn snapshot_of(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
        let mut files = Vec::new();
        files_of(folder, &mut files);
        files.sort();
        files.into_iter().map(|path| (path.clone(), fs_err::read(path).expect("readable"))).collect()
    }

    /// While a writer holds the store, its history is read, and no file of it changes.
    #[test]
    fn a_copy_is_read_while_a_writer_is_at_work() {
        let [dir, scratch] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
        assert!(CatalogueCopy::of(dir.path(), scratch.path()).expect("no store").is_none());
        let store = Store::create_or_open(dir.path()).expect("opens");
        let shard = store.put_bytes(b"a").expect("room");
        store.publish(&manifest(1, &[shard]), &Extras::new()).expect("publishes");
        fs_err::write(dir.path().join("tmp/7.part"), "of the writer").expect("writes");
        let before = snapshot_of(dir.path());
        let copy = CatalogueCopy::of(dir.path(), scratch.path()).expect("copies").expect("there");
        let generations = copy.generations().expect("reads");
        assert_eq!(generations.iter().map(|record| record.generation).collect::<Vec<_>>(), [1]);
        assert!(snapshot_of(dir.path()) == before, "the store was written to");
        drop(copy);
        assert_eq!(fs_err::read_dir(scratch.path()).expect("there").count(), 0);
        drop(store);
    }
}
