//! Files that survive a power cut: written beside, synced, renamed, the folder synced.

use std::io::{self, BufWriter, Write};
use std::path::Path;

use fs_err::File;
use slag_common::Hash32;
pub(super) use slag_common::durable::{Access, move_into_place, replace, sync_folder};

/// Counts and hashes what passes on its way to a file.
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
    /// Creates a file that must not exist.
    pub(super) fn create(path: &Path) -> io::Result<Self> {
        Ok(Self { file: BufWriter::new(File::create_new(path)?), hasher: blake3::Hasher::new() })
    }

    /// Makes the file durable and returns the hash and length of its content.
    pub(super) fn finish(self) -> io::Result<(Hash32, u64)> {
        let file = self.file.into_inner().map_err(io::IntoInnerError::into_error)?;
        file.sync_all()?;
        Ok((Hash32(*self.hasher.finalize().as_bytes()), self.hasher.count()))
    }
}

/// Returns the hash and length of a file's content, read piece by piece.
pub(super) fn hash_of(path: &Path) -> io::Result<(Hash32, u64)> {
    Hash32::of_reader(File::open(path)?)
}

/// Creates a folder durably, unless it is there.
pub(super) fn ensure_folder(path: &Path) -> io::Result<()> {
    ensure_folder_unsynced(path)?;
    path.parent().map_or(Ok(()), sync_folder)
}

/// Creates a folder, unless it is there; its name is durable once its parent is synced.
pub(super) fn ensure_folder_unsynced(path: &Path) -> io::Result<()> {
    match fs_err::create_dir(path) {
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        made => made,
    }
}
