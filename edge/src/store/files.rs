//! The storage interface: every step that a power cut can separate is one call of [`Files`].

use std::fs::{self, File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use slag_common::container::AlignedBytes;

use super::mmap::{self, FileBytes};

/// The medium cannot read a file: a bad sector, a broken inode.
#[derive(Debug, thiserror::Error)]
#[error("{path} cannot be read: {source}", path = path.display())]
struct BadMedium {
    path: PathBuf,
    source: io::Error,
}

/// Returns whether the medium failed: retries, permissions or space do not help.
pub fn is_bad_medium(e: &io::Error) -> bool {
    e.get_ref().is_some_and(|inner| inner.is::<BadMedium>())
}

fn at(path: &Path) -> impl Fn(io::Error) -> io::Error {
    // Error codes of file systems and block devices. Linux: EIO, ENXIO, EBADE, ENODATA, ENOLINK, EBADMSG, EILSEQ,
    // ETIMEDOUT, EUCLEAN (a broken inode), EREMOTEIO.
    let codes: &[i32] = match cfg!(target_os = "linux") {
        true => &[5, 6, 52, 61, 67, 74, 84, 110, 117, 121],
        false => &[5],
    };
    move |source| match source.raw_os_error().is_some_and(|code| codes.contains(&code)) {
        true => bad_medium(path, source),
        false => io::Error::new(source.kind(), format!("{}: {source}", path.display())),
    }
}

/// Opens a file of the cache to read. Other kinds are refused: a pipe could block its reader for ever.
fn open(path: &Path) -> io::Result<File> {
    let flags = rustix::fs::OFlags::NONBLOCK.bits() as i32;
    let file = OpenOptions::new().read(true).custom_flags(flags).open(path).map_err(at(path))?;
    if file.metadata().map_err(at(path))?.is_file() {
        return Ok(file);
    }
    let what = "a folder, a pipe or a device is there, expected a file";
    Err(bad_medium(path, io::Error::new(io::ErrorKind::InvalidData, what)))
}

/// Removes a folder, which a rename does not replace, or a pipe, which blocks its writer. Links stay.
fn make_way(path: &Path) -> io::Result<()> {
    match fs::symlink_metadata(path) {
        Ok(about) if about.is_dir() => fs::remove_dir_all(path).map_err(at(path)),
        Ok(about) if !about.is_file() && !about.is_symlink() => fs::remove_file(path).map_err(at(path)),
        // The user of the path reports its errors.
        _ => Ok(()),
    }
}

pub fn bad_medium(path: &Path, source: io::Error) -> io::Error {
    io::Error::new(source.kind(), BadMedium { path: path.to_owned(), source })
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stat {
    pub len_bytes: u64,
    /// Time of the last change, if the file system records it.
    pub modified: Option<SystemTime>,
    pub inode: u64,
}

/// File operations of the cache.
///
/// Errors are those of the file system, with the path. All paths are the cache's own: a folder, pipe or device in a
/// file's place is never read, and removed where a file is written, renamed or removed. Nothing is durable before
/// [`Files::sync`] of the file and [`Files::sync_dir`] of its folder.
pub trait Files: Send + Sync {
    /// Creates a folder and its parents, durably.
    fn create_dir(&self, dir: &Path) -> io::Result<()>;
    /// Writes at an offset, creating the file if necessary, and truncates it after the new bytes. Bytes between the
    /// old end and the offset are zero.
    fn write_from(&self, path: &Path, offset_bytes: u64, bytes: &[u8]) -> io::Result<()>;
    fn sync(&self, path: &Path) -> io::Result<()>;
    /// Renames within the cache, replacing the target.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Makes the entries of a folder durable.
    fn sync_dir(&self, dir: &Path) -> io::Result<()>;
    /// Removes a file, if it exists.
    fn remove(&self, path: &Path) -> io::Result<()>;
    /// Returns the names of the files in a folder, sorted; skips names that are not UTF-8.
    fn list(&self, dir: &Path) -> io::Result<Vec<String>>;
    fn read(&self, path: &Path, max_bytes: u64) -> io::Result<AlignedBytes>;
    /// Maps an immutable file. An unreadable page then ends the program: read the file first.
    fn map(&self, path: &Path) -> io::Result<FileBytes>;
    /// Returns a file's metadata; `None` if it does not exist.
    fn stat(&self, path: &Path) -> io::Result<Option<Stat>>;
    /// Returns the free space for this user on a folder's file system.
    fn free_bytes(&self, dir: &Path) -> io::Result<u64>;
}

/// Replaces a small file durably by renaming another: its path always holds the old or the new content, whole.
pub fn put_through(files: &dyn Files, aside: &Path, bytes: &[u8], path: &Path) -> io::Result<()> {
    files.write_from(aside, 0, bytes)?;
    files.sync(aside)?;
    files.rename(aside, path)?;
    path.parent().map_or(Ok(()), |dir| files.sync_dir(dir))
}

#[derive(Clone, Copy, Debug, Default)]
pub struct DiskFiles;

impl Files for DiskFiles {
    fn create_dir(&self, dir: &Path) -> io::Result<()> {
        fs::create_dir_all(dir).map_err(at(dir))?;
        match dir.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => self.sync_dir(parent),
            _ => Ok(()),
        }
    }

    fn write_from(&self, path: &Path, offset_bytes: u64, bytes: &[u8]) -> io::Result<()> {
        make_way(path)?;
        let write = || {
            let mut file = OpenOptions::new().write(true).create(true).truncate(false).open(path)?;
            file.set_len(offset_bytes)?;
            file.seek(SeekFrom::Start(offset_bytes))?;
            file.write_all(bytes)
        };
        write().map_err(at(path))
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        OpenOptions::new().write(true).open(path).and_then(|file| file.sync_all()).map_err(at(path))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        make_way(to)?;
        fs::rename(from, to).map_err(at(to))
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        slag_common::durable::sync_folder(dir)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        make_way(path)?;
        match fs::remove_file(path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
            other => other.map_err(at(path)),
        }
    }

    fn list(&self, dir: &Path) -> io::Result<Vec<String>> {
        let mut names = Vec::new();
        for entry in fs::read_dir(dir).map_err(at(dir))? {
            let entry = entry.map_err(at(dir))?;
            // An entry of unreadable kind is listed, as an unreadable file.
            if entry.file_type().is_ok_and(|kind| !kind.is_file()) {
                continue;
            }
            names.extend(entry.file_name().into_string());
        }
        names.sort_unstable();
        Ok(names)
    }

    fn read(&self, path: &Path, max_bytes: u64) -> io::Result<AlignedBytes> {
        let file = open(path)?;
        let len_bytes = file.metadata().map_err(at(path))?.len();
        if len_bytes > max_bytes {
            let path = path.display();
            let what = format!(
                "{path} is longer than {max_bytes} bytes, the limit for this kind of file; it is damaged"
            );
            return Err(io::Error::new(io::ErrorKind::InvalidData, what));
        }
        // Whatever the code: the file is open, but its bytes cannot be read.
        AlignedBytes::read_from(file, len_bytes as usize).map_err(|e| bad_medium(path, e))
    }

    fn map(&self, path: &Path) -> io::Result<FileBytes> {
        mmap::map(&open(path)?, path)
    }

    fn stat(&self, path: &Path) -> io::Result<Option<Stat>> {
        let metadata = match fs::metadata(path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            other => other.map_err(at(path))?,
        };
        let inode = metadata.ino();
        Ok(Some(Stat { len_bytes: metadata.len(), modified: metadata.modified().ok(), inode }))
    }

    fn free_bytes(&self, dir: &Path) -> io::Result<u64> {
        let stat = rustix::fs::statvfs(dir).map_err(|e| at(dir)(e.into()))?;
        Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
    }
}
