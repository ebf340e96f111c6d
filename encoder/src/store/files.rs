//! Files that survive a power cut: written beside, synced, renamed, the folder synced.

use std::io::{self, BufWriter, Write};
use std::path::Path;

use fs_err::File;
use slag_common::Hash32;

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

/// Who may read a file that is made.
#[derive(Clone, Copy)]
pub(super) enum Access {
    /// Whoever the process' umask lets.
    Shared,
    /// The owner alone (mode 0600).
    Private,
}

/// Replaces `path` by `bytes`: a crash leaves the old content or the new, whole.
pub(super) fn replace(part: &Path, path: &Path, bytes: &[u8], access: Access) -> io::Result<()> {
    let mut options = fs_err::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    if matches!(access, Access::Private) {
        use fs_err::os::unix::fs::OpenOptionsExt;
        options.mode(0o600);
    }
    let mut file = options.open(part)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    move_into_place(part, path)
}

/// Replaces a working file by `bytes`, written beside as `.part` first: whole or not at all after a crash.
pub(crate) fn write_durably(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = Path::new(&part);
    if part.exists() {
        fs_err::remove_file(part)?;
    }
    replace(part, path, bytes, Access::Shared)
}

/// Renames a synced file and makes its new name durable.
pub(super) fn move_into_place(part: &Path, path: &Path) -> io::Result<()> {
    fs_err::rename(part, path)?;
    path.parent().map_or(Ok(()), sync_folder)
}

/// Makes the names in a folder durable.
pub(super) fn sync_folder(path: &Path) -> io::Result<()> {
    // Elsewhere a folder cannot be opened for syncing; the file system orders renames itself.
    if cfg!(unix) { File::open(path)?.sync_all() } else { Ok(()) }
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
