//! The storage interface: every step that a power cut can separate is one call of [`Files`].

use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::time::SystemTime;

use super::mmap::{self, FileBytes};

/// File metadata.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stat {
    /// Length.
    pub len_bytes: u64,
    /// Time of the last change, if the file system records it.
    pub modified: Option<SystemTime>,
    /// Inode number; 0 if there is none.
    pub inode: u64,
}

/// File operations of the cache.
///
/// Errors are those of the file system, with the path. Nothing is durable before [`Files::sync`] of the file
/// and [`Files::sync_dir`] of its folder.
pub trait Files: Send + Sync {
    /// Creates a folder and its parents, durably.
    fn create_dir(&self, dir: &Path) -> io::Result<()>;
    /// Writes at an offset, creating the file if necessary, and truncates it behind the new bytes. Bytes
    /// between the old end and the offset are zero.
    fn write_from(&self, path: &Path, offset_bytes: u64, bytes: &[u8]) -> io::Result<()>;
    /// Makes a file's content durable.
    fn sync(&self, path: &Path) -> io::Result<()>;
    /// Renames within the cache, replacing the target.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Makes the entries of a folder durable.
    fn sync_dir(&self, dir: &Path) -> io::Result<()>;
    /// Removes a file, if it exists.
    fn remove(&self, path: &Path) -> io::Result<()>;
    /// Returns the names of the files in a folder, sorted; skips names that are not UTF-8.
    fn list(&self, dir: &Path) -> io::Result<Vec<String>>;
    /// Reads a file of at most `max_bytes`.
    fn read(&self, path: &Path, max_bytes: u64) -> io::Result<Vec<u8>>;
    /// Returns the bytes of an immutable file.
    fn map(&self, path: &Path) -> io::Result<FileBytes>;
    /// Returns a file's metadata; `None` if it does not exist.
    fn stat(&self, path: &Path) -> io::Result<Option<Stat>>;
    /// Returns the free space of the file system that holds a folder, as far as this user may use it; `None` if
    /// the system does not say.
    fn free_bytes(&self, dir: &Path) -> io::Result<Option<u64>>;
}

/// The real file system.
#[derive(Clone, Copy, Debug, Default)]
pub struct DiskFiles;

impl Files for DiskFiles {
    fn create_dir(&self, dir: &Path) -> io::Result<()> {
        fs_err::create_dir_all(dir)?;
        match dir.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => self.sync_dir(parent),
            _ => Ok(()),
        }
    }

    fn write_from(&self, path: &Path, offset_bytes: u64, bytes: &[u8]) -> io::Result<()> {
        let mut file = fs_err::OpenOptions::new().write(true).create(true).truncate(false).open(path)?;
        file.set_len(offset_bytes)?;
        file.seek(SeekFrom::Start(offset_bytes))?;
        file.write_all(bytes)
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        fs_err::OpenOptions::new().write(true).open(path)?.sync_all()
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs_err::rename(from, to)
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        slag_common::durable::sync_folder(dir)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        match fs_err::remove_file(path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
            other => other,
        }
    }

    fn list(&self, dir: &Path) -> io::Result<Vec<String>> {
        let mut names = Vec::new();
        for entry in fs_err::read_dir(dir)? {
            let entry = entry?;
            if entry.file_type()?.is_file()
                && let Ok(name) = entry.file_name().into_string()
            {
                names.push(name);
            }
        }
        names.sort_unstable();
        Ok(names)
    }

    fn read(&self, path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        fs_err::File::open(path)?.take(max_bytes.saturating_add(1)).read_to_end(&mut bytes)?;
        if bytes.len() as u64 > max_bytes {
            let what = format!(
                "{} is longer than {max_bytes} bytes, the limit for this kind of file; it is damaged",
                path.display()
            );
            return Err(io::Error::new(io::ErrorKind::InvalidData, what));
        }
        Ok(bytes)
    }

    fn map(&self, path: &Path) -> io::Result<FileBytes> {
        mmap::map(path)
    }

    fn stat(&self, path: &Path) -> io::Result<Option<Stat>> {
        let metadata = match fs_err::metadata(path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            other => other?,
        };
        #[cfg(unix)]
        let inode = std::os::unix::fs::MetadataExt::ino(&metadata);
        #[cfg(not(unix))]
        let inode = 0;
        Ok(Some(Stat { len_bytes: metadata.len(), modified: metadata.modified().ok(), inode }))
    }

    #[cfg(unix)]
    fn free_bytes(&self, dir: &Path) -> io::Result<Option<u64>> {
        let stat = rustix::fs::statvfs(dir)
            .map_err(|e| io::Error::new(e.kind(), format!("free space of {}: {e}", dir.display())))?;
        Ok(Some(stat.f_bavail.saturating_mul(stat.f_frsize)))
    }

    #[cfg(not(unix))]
    fn free_bytes(&self, _dir: &Path) -> io::Result<Option<u64>> {
        Ok(None)
    }
}
