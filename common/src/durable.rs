//! Files that survive a power cut: written under a temporary name, synced, renamed, and the folder synced.
//!
//! Instead of the crate `atomic-write-file`: it needs the final name first (objects are named by the hash of their
//! content) and makes up temporary names, which a restart could not find and remove.

use std::io::{self, Write};
use std::path::Path;

use fs_err::File;

/// The readers of a new file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Those that the process's umask allows.
    Shared,
    /// The owner only (mode 0600).
    Private,
}

/// Replaces a file through `PATH.part`: after a crash it has either its complete old content or its complete new
/// one.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = Path::new(&part);
    if part.exists() {
        fs_err::remove_file(part)?;
    }
    replace(part, path, bytes, Access::Shared)
}

/// Replaces the content of `path` by `bytes` through `part`, which must not exist and must be on the same file
/// system.
pub fn replace(part: &Path, path: &Path, bytes: &[u8], access: Access) -> io::Result<()> {
    let mut options = fs_err::OpenOptions::new();
    options.write(true).create_new(true);
    if matches!(access, Access::Private) {
        use fs_err::os::unix::fs::OpenOptionsExt;
        options.mode(0o600);
    }
    let mut file = options.open(part)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    move_into_place(part, path)
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

    /// A process has one current folder, so this file lies in that of all tests for a moment.
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
}
