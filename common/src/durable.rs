//! Files that survive a power cut: written under a temporary name, synced, renamed, and the folder synced.
//!
//! Instead of the crate `atomic-write-file`: it needs the final name first (objects are named by the hash of their
//! content) and makes up temporary names, which a restart could not find and remove.

use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use fs_err::File;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Those that the process's umask allows.
    Shared,
    /// The owner only (mode 0600).
    Private,
}

/// Replaces a file through `PATH.part`; after a crash it has its complete old or its complete new content.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let part = part_of(path);
    if part.exists() {
        fs_err::remove_file(&part)?;
    }
    replace(&part, path, bytes, Access::Shared)
}

/// Names may have 255 bytes, so long ones stand as their hash.
fn part_of(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default();
    let mut part = match name.len() {
        0..=250 => name.to_owned(),
        _ => format!("{:016x}", BuildHasherDefault::<DefaultHasher>::default().hash_one(name)).into(),
    };
    part.push(".part");
    path.with_file_name(part)
}

/// Writes a file that a user named; its old content stays until the new one is complete. Pipes, devices and
/// files in folders that take no new ones are written in place.
pub fn write_result<E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), E> {
    // Write to the target of a link, so that the link stays.
    let path = &std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let is_device = path.starts_with("/dev") || std::fs::metadata(path).is_ok_and(|about| !about.is_file());
    let part = part_of(path);
    let beside = if is_device { None } else { File::create(&part).map(Some).or_else(in_place)? };
    let is_beside = beside.is_some();
    let mut out = BufWriter::new(beside.map_or_else(|| File::create(path), Ok)?);
    let finish = || {
        write(&mut out)?;
        out.flush()?;
        if is_beside {
            out.get_ref().sync_all()?;
            move_into_place(&part, path)?;
        }
        Ok(())
    };
    let finished = finish();
    if finished.is_err() && is_beside {
        // The caller gets the first error.
        let _ = std::fs::remove_file(&part);
    }
    finished
}

fn in_place(error: io::Error) -> io::Result<Option<File>> {
    match error.kind() {
        ErrorKind::PermissionDenied => Ok(None),
        _ => Err(error),
    }
}

/// Replaces the content of `path` through `part`, which must not exist and must be on the same file system.
pub fn replace(part: &Path, path: &Path, bytes: &[u8], access: Access) -> io::Result<()> {
    let mut options = fs_err::OpenOptions::new();
    options.write(true).create_new(true);
    if matches!(access, Access::Private) {
        use fs_err::os::unix::fs::OpenOptionsExt;
        options.mode(0o600);
    }
    let mut file = options.open(part)?;
    let written =
        file.write_all(bytes).and_then(|()| file.sync_all()).and_then(|()| move_into_place(part, path));
    if written.is_err() {
        // The caller gets the first error.
        let _ = fs_err::remove_file(part);
    }
    written
}

/// Renames a synced file, durably.
pub fn move_into_place(part: &Path, path: &Path) -> io::Result<()> {
    fs_err::rename(part, path)?;
    path.parent().map_or(Ok(()), sync_folder)
}

/// Makes the names in a folder durable.
pub fn sync_folder(path: &Path) -> io::Result<()> {
    // The folder of a name alone is the empty path, which cannot be opened.
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    File::open(path)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The file is in the working folder of the whole process, so all tests see it for a moment.
    #[test]
    fn a_name_alone_is_a_file_of_the_current_folder() {
        let name = format!("durable-test-{}", std::process::id());
        let path = Path::new(&name);
        for bytes in [b"old", b"new"] {
            let written = write(path, bytes);
            let read = std::fs::read(path);
            assert!(written.is_ok() && read.is_ok_and(|read| read == bytes), "{written:?}");
        }
        std::fs::remove_file(path).expect("written above");
        assert!(!std::fs::exists(format!("{name}.part")).expect("a path"));
    }

    #[test]
    fn the_longest_names_are_written() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        for name in ["a", "b"].map(|letter| letter.repeat(255)) {
            write(&dir.path().join(&name), name.as_bytes()).expect("written");
            write_result(&dir.path().join(&name), |out| out.write_all(b"new")).expect("written");
        }
        assert_eq!(std::fs::read_dir(dir.path()).expect("listed").count(), 2);
    }

    /// A result that fails half way leaves the old file, and no other.
    #[test]
    fn a_result_is_whole_or_not_there() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let path = dir.path().join("result");
        let write = |bytes: &'static [u8], is_full: bool| {
            write_result(&path, |out| {
                out.write_all(bytes)?;
                if is_full { Err(io::Error::from(ErrorKind::StorageFull)) } else { Ok(()) }
            })
        };
        let files = || std::fs::read_dir(dir.path()).expect("listed").count();
        assert!(write(b"cut", true).is_err());
        assert_eq!(files(), 0);
        write(b"old", false).expect("written");
        assert!(write(b"cut", true).is_err());
        assert_eq!((std::fs::read(&path).expect("read"), files()), (b"old".to_vec(), 1));
        write(b"new", false).expect("written");
        assert_eq!((std::fs::read(&path).expect("read"), files()), (b"new".to_vec(), 1));
    }

    /// The link and the file's permissions stay.
    #[test]
    fn links_and_devices_are_written_through() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let [target, link] = ["target", "link"].map(|name| dir.path().join(name));
        std::fs::write(&target, "old").expect("written");
        std::os::unix::fs::symlink(&target, &link).expect("linked");
        let write = |path: &Path| write_result(path, |out| out.write_all(b"new"));
        write(&link).expect("written");
        assert!(std::fs::symlink_metadata(&link).expect("there").is_symlink());
        assert_eq!(std::fs::read(&target).expect("read"), b"new");
        write(Path::new("/dev/null")).expect("written");
        assert!(!std::fs::exists("/dev/null.part").expect("a path"));
    }
}
