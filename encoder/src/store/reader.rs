//! The lock-free side of a store: needs the manifest, the public key and the objects alone.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use slag_common::Hash32;
use slag_common::container::AlignedBytes;
use slag_common::manifest::{CellRecord, Manifest, ShardRecord, TextModelRecord};
use slag_common::objects::Objects;
use slag_common::shard::{HEADER_END_BYTES, ShardLayout, ShardView};

use super::files::ModelsRecord;
use super::{StoreError, files};

/// Objects by name that belong to a generation but are not sent to robots.
pub type Extras = BTreeMap<String, Hash32>;

#[derive(Clone, Debug)]
pub struct Published {
    pub manifest: Manifest,
    /// As robots get them.
    pub bytes: Vec<u8>,
    /// BLAKE3 of the bytes.
    pub hash: Hash32,
    /// Beside the shards.
    pub extras: Extras,
}

impl Published {
    fn read(dir: &Path, name: &str) -> Result<Self, StoreError> {
        let (manifest, bytes) = read_manifest(&dir.join(name))?;
        let hash = Hash32::of(&bytes);
        let path = extras_path(dir, hash);
        let damaged = |what| StoreError::Extras { path: path.clone(), what };
        let extras = files::if_there(fs_err::read(&path))?.ok_or_else(|| damaged("it is missing".into()))?;
        let extras = serde_json::from_slice(&extras).map_err(|e| damaged(e.to_string()))?;
        Ok(Self { manifest, bytes, hash, extras })
    }

    pub(crate) fn shard_lens(&self) -> BTreeMap<Hash32, u64> {
        let shards = self.manifest.cells.iter().flat_map(|cell| cell.shards.values());
        shards.map(|shard| (shard.hash, shard.len_bytes)).collect()
    }

    /// Lengths of all that robots may fetch, by hash: the shards and, if there is one, the text model.
    pub(crate) fn object_lens(&self) -> BTreeMap<Hash32, u64> {
        let text_model = self.manifest.encoder.text_model.iter().flat_map(TextModelRecord::objects);
        let text_model = text_model.map(|object| (object.hash, object.len_bytes));
        self.shard_lens().into_iter().chain(text_model).collect()
    }

    /// Hashes of all that robots may fetch, and of extras.
    pub(super) fn all_objects(&self) -> BTreeSet<Hash32> {
        self.object_lens().into_keys().chain(self.extras.values().copied()).collect()
    }
}

/// A file's version, read without its content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stamp {
    modified: Option<SystemTime>,
    len_bytes: u64,
    inode: u64,
}

impl Stamp {
    /// `None` if there is no manifest or its file metadata cannot be read.
    pub(crate) fn of_manifest(dir: &Path) -> Option<Self> {
        Self::of(&dir.join(files::MANIFEST)).ok()
    }

    fn of(path: &Path) -> io::Result<Self> {
        let metadata = slag_common::files::metadata(path)?;
        let inode = std::os::unix::fs::MetadataExt::ino(&metadata);
        Ok(Self { modified: metadata.modified().ok(), len_bytes: metadata.len(), inode })
    }
}

/// Snapshot of a published store; stays readable while a writer publishes the next generation.
#[derive(Clone, Debug)]
pub struct StoreReader {
    dir: PathBuf,
    current: Published,
    previous: Option<Published>,
    stamp: Stamp,
}

impl StoreReader {
    /// Reads the manifest.
    ///
    /// # Errors
    /// [`StoreError::NotPublished`] before the first publication, [`StoreError::ManifestLost`] where its manifest is
    /// gone since, [`StoreError`] otherwise.
    pub fn open(dir: &Path) -> Result<Self, StoreError> {
        let path = dir.join(files::MANIFEST);
        // Before the content, so that a replacement in between is noticed.
        let stamp = Stamp::of(&path).map_err(|e| match e.kind() {
            io::ErrorKind::NotFound if was_published(dir) => StoreError::ManifestLost { path },
            io::ErrorKind::NotFound => StoreError::NotPublished { path },
            _ => e.into(),
        })?;
        let current = Published::read(dir, files::MANIFEST)?;
        let previous = match Published::read(dir, files::MANIFEST_PREVIOUS) {
            Ok(previous) => Some(previous),
            Err(StoreError::NotPublished { .. }) => None,
            Err(e) => {
                // It only serves fetches that began before the last publication.
                tracing::warn!("the previous manifest is left aside: {e}");
                None
            }
        };
        Ok(Self { dir: dir.to_owned(), current, previous, stamp })
    }

    pub(crate) fn stamp(&self) -> Stamp {
        self.stamp
    }

    /// Whether the store still has this reader's manifest (one `stat`).
    pub(crate) fn is_current(&self) -> bool {
        Stamp::of(&self.dir.join(files::MANIFEST)).is_ok_and(|stamp| stamp == self.stamp)
    }

    /// Models of the current generation, if the store recorded them.
    pub(crate) fn models(&self) -> Result<Option<ModelsRecord>, StoreError> {
        let record = ModelsRecord::read(&self.dir)?;
        Ok(record.filter(|record| record.encoder == self.manifest().encoder.id))
    }

    pub fn dir(&self) -> &Path {
        &self.dir
    }

    pub fn current(&self) -> &Published {
        &self.current
    }

    pub(crate) fn previous(&self) -> Option<&Published> {
        self.previous.as_ref()
    }

    pub fn manifest(&self) -> &Manifest {
        &self.current.manifest
    }

    /// Path of an object, which need not exist.
    pub(crate) fn object_path(&self, hash: Hash32) -> PathBuf {
        object_path(&self.dir, hash)
    }

    /// First bytes of one of a cell's shards, with its header and table; `None` where they cannot be read.
    pub(crate) fn shard_head(&self, cell: &CellRecord) -> Option<Vec<u8>> {
        let file = slag_common::files::open(&self.object_path(cell.shards.values().next()?.hash)).ok()?;
        let mut head = Vec::new();
        file.take(HEADER_END_BYTES).read_to_end(&mut head).ok()?;
        Some(head)
    }

    pub fn read_object(&self, hash: Hash32) -> Result<AlignedBytes, StoreError> {
        let path = self.object_path(hash);
        let bytes = files::if_there(AlignedBytes::read(&path))?;
        let bytes = bytes.ok_or_else(|| {
            let path = path.display();
            StoreError::Failed(format!("{path}: it is missing; encode again, which writes it anew"))
        })?;
        match Hash32::of(&bytes) {
            found if found == hash => Ok(bytes),
            found => Err(StoreError::ObjectHash { path, found }),
        }
    }

    pub fn read_shard(&self, record: &ShardRecord) -> Result<StoredShard, StoreError> {
        let bytes = self.read_object(record.hash)?;
        let damaged = |cause| StoreError::Shard { path: self.object_path(record.hash), cause };
        Ok(StoredShard { layout: ShardLayout::check(&bytes).map_err(damaged)?, bytes })
    }
}

pub struct StoredShard {
    pub bytes: AlignedBytes,
    pub layout: ShardLayout,
}

impl StoredShard {
    pub fn view(&self) -> ShardView<'_> {
        self.layout.view(&self.bytes)
    }

    pub fn objects(&self) -> Option<Objects<'_>> {
        self.layout.additions(&self.bytes).objects
    }
}

pub(super) fn object_path(dir: &Path, hash: Hash32) -> PathBuf {
    let name = hash.to_string();
    dir.join("objects").join(&name[..2]).join(name)
}

pub(super) fn extras_path(dir: &Path, manifest_hash: Hash32) -> PathBuf {
    dir.join("extras").join(manifest_hash.to_string())
}

/// Whether anything was ever published into a store.
fn was_published(dir: &Path) -> bool {
    [files::MANIFEST_PREVIOUS, "metadata/timestamp.json"].iter().any(|name| dir.join(name).exists())
}

/// Name of a store's published scene, from the previous generation if the current one cannot be read; `None` if neither
/// can.
pub(crate) fn scene_name(dir: &Path) -> Option<String> {
    let read = |name: &str| read_manifest(&dir.join(name)).ok();
    let (manifest, _) = read(files::MANIFEST).or_else(|| read(files::MANIFEST_PREVIOUS))?;
    Some(manifest.scene)
}

pub(super) fn read_manifest(path: &Path) -> Result<(Manifest, Vec<u8>), StoreError> {
    let Some(bytes) = files::read_manifest_bytes(path)? else {
        return Err(StoreError::NotPublished { path: path.to_owned() });
    };
    let refused = |cause| StoreError::Manifest { path: path.to_owned(), cause };
    Ok((Manifest::parse(&bytes).map_err(refused)?, bytes))
}
