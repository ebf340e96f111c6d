//! Files that survive a power cut: written beside, synced, renamed, the folder synced; and those of manifests.

use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use fs_err::File;
use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::{self, ManifestError};

use super::StoreError;

pub(super) use slag_common::durable::{Access, move_into_place, replace, sync_folder};

pub(super) struct HashingWriter {
    file: BufWriter<File>,
    hasher: blake3::Hasher,
}

impl Write for HashingWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = self.file.write(bytes)?;
        self.hasher.update(&bytes[..n]);
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl HashingWriter {
    /// The file must not exist.
    pub(super) fn create(path: &Path) -> io::Result<Self> {
        Ok(Self { file: BufWriter::new(File::create_new(path)?), hasher: blake3::Hasher::new() })
    }

    /// Makes the file durable; returns its hash and length.
    pub(super) fn finish(self) -> io::Result<(Hash32, u64)> {
        let file = self.file.into_inner().map_err(io::IntoInnerError::into_error)?;
        file.sync_all()?;
        Ok((Hash32(*self.hasher.finalize().as_bytes()), self.hasher.count()))
    }
}

/// `None` for what is not there.
pub(super) fn if_there<T>(found: io::Result<T>) -> io::Result<Option<T>> {
    match found {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        found => found.map(Some),
    }
}

/// Hash and length of a file, read piece by piece.
pub(super) fn hash_of(path: &Path) -> io::Result<(Hash32, u64)> {
    Hash32::of_reader(File::open(path)?)
}

/// Creates a folder durably, if missing.
pub(super) fn ensure_folder(path: &Path) -> io::Result<()> {
    ensure_folder_unsynced(path)?;
    path.parent().map_or(Ok(()), sync_folder)
}

/// Creates a folder, if missing; its name is durable once its parent is synced.
pub(super) fn ensure_folder_unsynced(path: &Path) -> io::Result<()> {
    match fs_err::create_dir(path) {
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        made => made,
    }
}

/// Removes the files of a folder, if it exists, whose names are chosen; returns their number and bytes.
pub(crate) fn remove_files(folder: &Path, is_chosen: impl Fn(&str) -> bool) -> io::Result<(u64, u64)> {
    let entries = match fs_err::read_dir(folder) {
        Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            return Ok((0, 0));
        }
        entries => entries?,
    };
    let (mut n_files, mut len_bytes) = (0, 0);
    for entry in entries {
        let entry = entry?;
        let metadata = entry.metadata()?;
        if !metadata.is_dir() && entry.file_name().to_str().is_some_and(&is_chosen) {
            fs_err::remove_file(entry.path())?;
            n_files += 1;
            len_bytes += metadata.len();
        }
    }
    Ok((n_files, len_bytes))
}

pub(super) const MANIFEST: &str = "manifest";
/// For fetches that began before the last publication.
pub(super) const MANIFEST_PREVIOUS: &str = "manifest.previous";

/// `None` if there is no such file.
pub(super) fn read_manifest_bytes(path: &Path) -> Result<Option<Vec<u8>>, StoreError> {
    read_limited(path, manifest::MAX_BYTES, |len_bytes| {
        let cause = ManifestError::TooLong { len_bytes };
        StoreError::Manifest { path: path.to_owned(), cause }
    })
}

/// Reads at most `max_bytes`; `None` if there is no such file.
pub(super) fn read_limited(
    path: &Path,
    max_bytes: u64,
    too_long: impl FnOnce(u64) -> StoreError,
) -> Result<Option<Vec<u8>>, StoreError> {
    let Some(file) = if_there(File::open(path))? else { return Ok(None) };
    let mut bytes = Vec::new();
    match file.take(max_bytes + 1).read_to_end(&mut bytes)? as u64 {
        n if n > max_bytes => Err(too_long(n)),
        _ => Ok(Some(bytes)),
    }
}

const FILE: &str = "models.json";

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ModelsRecord {
    /// The encoder's id, as the manifest has it.
    pub(crate) encoder: Hash32,
    /// Name or folder of the models; `None` for the embedded ones.
    pub(crate) models: Option<PathBuf>,
}

impl ModelsRecord {
    pub(super) fn path(dir: &Path) -> PathBuf {
        dir.join(FILE)
    }

    /// An unreadable record counts as absent: the user can still name the models.
    pub(super) fn read(dir: &Path) -> io::Result<Option<Self>> {
        let bytes = if_there(fs_err::read(Self::path(dir)))?;
        Ok(bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok()))
    }
}
