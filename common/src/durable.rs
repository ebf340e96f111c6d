//! Files that survive a power cut: written beside their final name, synced, renamed, and the folder synced.

use std::io::{self, Write};
use std::path::Path;

use fs_err::File;

/// Who may read a new file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Everyone the process's umask allows.
    Shared,
    /// The owner only (mode 0600).
    Private,
}

/// Replaces a file: after a crash it has the old content or the new, whole. Writes `PATH.part` first.
///
/// # Errors
/// The file system's error, with the path.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = Path::new(&part);
    if part.exists() {
        fs_err::remove_file(part)?;
    }
    replace(part, path, bytes, Access::Shared)
}

/// Replaces `path` by `bytes` through `part`, which must not exist and must lie on the same file system.
///
/// # Errors
/// The file system's error, with the path.
pub fn replace(part: &Path, path: &Path, bytes: &[u8], access: Access) -> io::Result<()> {
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

/// Renames a synced file and makes its new name durable.
///
/// # Errors
/// The file system's error, with the path.
pub fn move_into_place(part: &Path, path: &Path) -> io::Result<()> {
    fs_err::rename(part, path)?;
    path.parent().map_or(Ok(()), sync_folder)
}

/// Makes the names in a folder durable.
///
/// # Errors
/// The file system's error, with the path.
pub fn sync_folder(path: &Path) -> io::Result<()> {
    // Elsewhere a folder cannot be opened for syncing; the file system orders renames itself.
    if cfg!(unix) { File::open(path)?.sync_all() } else { Ok(()) }
}
