//! The only writer of a store.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use slag_common::Hash32;
use slag_common::manifest::{Manifest, ManifestError};

use super::catalogue::Catalogue;
use super::files::{self, Access, HashingWriter, ModelsRecord};
use super::metadata::Metadata;
use super::reader::{self, Extras, Published, StoreReader};
use super::{StoreError, manifest_fault, verify};

/// sled releases the lock of a writer that has just ended on a thread of its own.
const LOCK_PATIENCE: Duration = Duration::from_secs(2);

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Pruned {
    pub n_files: u64,
    pub len_bytes: u64,
}

#[derive(Debug)]
pub struct Store {
    pub(super) dir: PathBuf,
    catalogue: Catalogue,
    n_parts: AtomicU64,
    /// Objects that this writer has hashed.
    read: Mutex<BTreeSet<Hash32>>,
}

impl Store {
    /// Opens a store for writing; creates it if it does not exist.
    ///
    /// # Errors
    /// [`StoreError::Locked`] while another process writes; [`StoreError`] otherwise.
    pub fn create_or_open(dir: &Path) -> Result<Self, StoreError> {
        check_folder(dir)?;
        fs_err::create_dir_all(dir)?;
        for folder in ["objects", "extras", "keys", "tmp"] {
            files::ensure_folder(&dir.join(folder))?;
        }
        // All at once, so that no object's durability waits on another thread's folder.
        for first in 0..=u8::MAX {
            files::ensure_folder_unsynced(&dir.join("objects").join(hex::encode([first])))?;
        }
        files::sync_folder(&dir.join("objects"))?;
        let catalogue = Catalogue::open(dir, LOCK_PATIENCE)?;
        // The lock is held, so files in tmp/ belong to a dead writer.
        files::remove_files(&dir.join("tmp"), |name| name.ends_with(".part"))?;
        let n_parts = AtomicU64::new(0);
        let store = Self { dir: dir.to_owned(), catalogue, n_parts, read: Mutex::default() };
        store.repair_records()?;
        Ok(store)
    }

    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Folder for working files of an encode, created if missing.
    pub(crate) fn job_dir(&self) -> Result<PathBuf, StoreError> {
        let path = self.dir.join("job");
        files::ensure_folder(&path)?;
        Ok(path)
    }

    #[cfg(test)]
    pub(super) fn catalogue(&self) -> &Catalogue {
        &self.catalogue
    }

    /// Record database, for the state of jobs and pushes. Records are durable once flushed.
    pub fn db(&self) -> &sled::Db {
        self.catalogue.db()
    }

    pub fn reader(&self) -> Result<StoreReader, StoreError> {
        StoreReader::open(&self.dir)
    }

    /// Writes an object through a callback; returns its hash and length. Safe from many threads, durable on return. An
    /// existing object is kept if its content has its hash, else replaced.
    pub(crate) fn put_object(
        &self,
        write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<(Hash32, u64), StoreError> {
        let part = self.part_path();
        let written = HashingWriter::create(&part).and_then(|mut out| {
            write(&mut out)?;
            out.finish()
        });
        let placed = written.and_then(|(hash, len_bytes)| {
            self.place_object(&part, hash)?;
            Ok((hash, len_bytes))
        });
        if placed.is_err() {
            // Best effort: the next writer clears tmp/ anyway, and the first error is the one to report.
            let _ = fs_err::remove_file(&part);
        }
        Ok(placed?)
    }

    pub fn put_bytes(&self, bytes: &[u8]) -> Result<(Hash32, u64), StoreError> {
        self.put_object(|out| out.write_all(bytes))
    }

    fn place_object(&self, part: &Path, hash: Hash32) -> io::Result<()> {
        let path = reader::object_path(&self.dir, hash);
        match files::hash_of(&path) {
            Ok((found, _)) if found == hash => fs_err::remove_file(part)?,
            found => {
                if found.is_ok() {
                    tracing::warn!("{} was damaged; it is written anew", path.display());
                }
                files::move_into_place(part, &path)?;
            }
        }
        self.note_read(hash);
        Ok(())
    }

    pub fn next_generation(&self) -> Result<u64, StoreError> {
        Ok(self.catalogue.last_generation()?.map_or(1, |current| current.saturating_add(1)))
    }

    /// The keys that sign the next generation must be there.
    pub(crate) fn check_keys(&self) -> Result<(), StoreError> {
        self.metadata()?.check_keys()
    }

    /// Refuses the metadata of a store that was published if its root is lost.
    fn metadata(&self) -> Result<Metadata, StoreError> {
        let metadata = Metadata::open(&self.dir)?;
        if self.catalogue.last_generation()?.is_some() {
            metadata.check_root()?;
        }
        Ok(metadata)
    }

    /// Signs a manifest and makes it, with its objects, the current one; returns its hash. Publishing the current
    /// manifest again changes nothing. Its next key is the store's, whatever `manifest` says. `extras`: objects by name
    /// that this generation needs but robots do not fetch (readers find them in [`Published::extras`]).
    ///
    /// # Errors
    /// [`StoreError::MissingObject`] if an object listed is not there in full, [`StoreError::ObjectHash`] if it is
    /// damaged, [`StoreError::Generation`] unless the generation is above the current one.
    pub fn publish(&self, manifest: &Manifest, extras: &Extras) -> Result<Hash32, StoreError> {
        for (hash, len_bytes, _) in verify::contents(manifest, extras) {
            self.check_object(hash, len_bytes)?;
        }
        let bytes = manifest.to_bytes();
        let path = self.dir.join(files::MANIFEST);
        let refuse = |cause| StoreError::Manifest { path: path.clone(), cause };
        Manifest::parse(&bytes).map_err(refuse)?;
        let hash = Hash32::of(&bytes);
        let current = match files::read_manifest_bytes(&path) {
            Err(StoreError::Manifest { .. }) => None,
            // A damaged one serves no fetch under way: the previous one stays.
            current => current?.filter(|bytes| Manifest::parse(bytes).is_ok()),
        };
        let again = current.as_deref() == Some(&bytes);
        match self.catalogue.last_generation()? {
            Some(generation) if manifest.generation <= generation && !again => {
                return Err(StoreError::Generation { found: manifest.generation, current: generation });
            }
            _ => {}
        }
        let metadata = self.metadata()?;
        // First, so that a manifest without a root is one whose root is lost.
        metadata.ensure_root(manifest.created_unix_secs)?;
        let extras_json = serde_json::to_vec(extras).expect("a map of strings is JSON");
        self.replace(&reader::extras_path(&self.dir, hash), &extras_json)?;
        if !again {
            if let Some(current) = current {
                self.replace(&self.dir.join(files::MANIFEST_PREVIOUS), &current)?;
            }
            self.replace(&path, &bytes)?;
        }
        metadata.publish(&bytes, manifest.created_unix_secs)?;
        self.catalogue.record(manifest, hash)?;
        Ok(hash)
    }

    pub(crate) fn remember_models(&self, record: &ModelsRecord) -> Result<(), StoreError> {
        let bytes = serde_json::to_vec(record).map_err(io::Error::from)?;
        self.replace(&ModelsRecord::path(&self.dir), &bytes)
    }

    /// Removes objects and extras that neither the current nor the previous manifest lists, including those of an
    /// encode that has not published yet: prune after publishing.
    pub fn prune(&self) -> Result<Pruned, StoreError> {
        let reader = self.reader()?;
        let both = || std::iter::once(reader.current()).chain(reader.previous());
        let extras: BTreeSet<Hash32> = both().map(|published| published.hash).collect();
        let objects: BTreeSet<Hash32> = both().flat_map(Published::all_objects).collect();
        let is_of_none = |name: &str, kept: &BTreeSet<Hash32>| {
            name.parse::<Hash32>().is_ok_and(|hash| !kept.contains(&hash))
        };
        let (_, mut len_bytes) =
            files::remove_files(&self.dir.join("extras"), |name| is_of_none(name, &extras))?;
        let mut n_files = 0;
        for first in 0..=u8::MAX {
            let folder = self.dir.join("objects").join(hex::encode([first]));
            let removed = files::remove_files(&folder, |name| is_of_none(name, &objects))?;
            (n_files, len_bytes) = (n_files + removed.0, len_bytes + removed.1);
        }
        Ok(Pruned { n_files, len_bytes })
    }

    /// Updates metadata and catalogue to the manifests, which a crash may have left ahead of them.
    fn repair_records(&self) -> Result<(), StoreError> {
        // Without the extras: the next publication replaces a damaged record of them.
        let read = |name: &str| reader::read_manifest(&self.dir.join(name));
        // It only serves fetches under way.
        if let Ok((manifest, bytes)) = read(files::MANIFEST_PREVIOUS) {
            self.catalogue.record(&manifest, Hash32::of(&bytes))?;
        }
        match read(files::MANIFEST) {
            Err(StoreError::NotPublished { .. }) => {}
            Err(StoreError::Manifest { path, cause }) => {
                self.check_is_damaged(&path, &cause)?;
                let fault = manifest_fault(&cause);
                tracing::warn!("{}: {fault}; the next publication writes it anew", path.display());
            }
            current => {
                let (manifest, bytes) = current?;
                Metadata::open(&self.dir)?.publish(&bytes, manifest.created_unix_secs)?;
                self.catalogue.record(&manifest, Hash32::of(&bytes))?;
            }
        }
        Ok(())
    }

    /// Refuses an unreadable but undamaged manifest, which belongs to another version of the program.
    fn check_is_damaged(&self, path: &Path, cause: &ManifestError) -> Result<(), StoreError> {
        let (path, cause) = (path.to_owned(), cause.clone());
        match &cause {
            ManifestError::Version { .. } => Err(StoreError::Manifest { path, cause }),
            ManifestError::Content { .. } => {
                let bytes = files::read_manifest_bytes(&path)?.unwrap_or_default();
                match Metadata::open(&self.dir)?.vouches_for(&bytes)? {
                    true => Err(StoreError::SignedManifest { path, cause }),
                    false => Ok(()),
                }
            }
            ManifestError::Damaged { .. } | ManifestError::TooLong { .. } => Ok(()),
        }
    }

    fn check_object(&self, hash: Hash32, expected_bytes: Option<u64>) -> Result<(), StoreError> {
        let path = reader::object_path(&self.dir, hash);
        let missing = |path, found_bytes| {
            let expected_bytes = expected_bytes.unwrap_or(0);
            Err(StoreError::MissingObject { hash, path, expected_bytes, found_bytes })
        };
        let is_read = self.read.lock().unwrap_or_else(PoisonError::into_inner).contains(&hash);
        let found = match is_read {
            // Written or read by this writer: only its presence is in question.
            true => slag_common::files::metadata(&path).map(|found| (hash, found.len())),
            false => files::hash_of(&path),
        };
        match found {
            Ok((_, n)) if expected_bytes.is_some_and(|expected| expected != n) => missing(path, Some(n)),
            Ok((found, _)) if found != hash => Err(StoreError::ObjectHash { path, found }),
            Ok(_) => {
                self.note_read(hash);
                Ok(())
            }
            Err(e) if e.kind() == io::ErrorKind::NotFound => missing(path, None),
            Err(e) => Err(e.into()),
        }
    }

    fn note_read(&self, hash: Hash32) {
        self.read.lock().unwrap_or_else(PoisonError::into_inner).insert(hash);
    }

    pub(super) fn replace(&self, path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
        Ok(files::replace(&self.part_path(), path, bytes, Access::Shared)?)
    }

    pub(super) fn part_path(&self) -> PathBuf {
        let part = self.n_parts.fetch_add(1, Ordering::Relaxed);
        self.dir.join("tmp").join(format!("{part}.part"))
    }
}

/// Names in a store's folder, and of what a new disk has.
const NAMES: &str = "objects metadata extras keys tmp db db.damaged job drawn models.json manifest manifest.previous lost+found";

/// Refuses a folder with files that are none of a store's. A store, published or only begun, may have others besides.
pub(crate) fn check_folder(dir: &Path) -> Result<(), StoreError> {
    let Some(entries) = files::if_there(fs_err::read_dir(dir))? else { return Ok(()) };
    let names = entries.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()));
    let names = names.collect::<io::Result<BTreeSet<String>>>()?;
    let is_store = names.contains("objects") && (names.contains("extras") || names.contains("db"));
    let mut others = names.iter().filter(|name| !NAMES.split(' ').any(|known| known == *name));
    match others.next() {
        Some(found) if !is_store => Err(StoreError::Failed(format!(
            "{}: it is no store and has other files, the first is {found:?}; name a store, or a folder that is empty or new",
            dir.display()
        ))),
        _ => Ok(()),
    }
}
