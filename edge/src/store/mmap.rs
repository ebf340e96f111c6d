//! Read-only memory maps: the only module of this crate with unsafe code.

use std::fs::File;
use std::io;
use std::ops::Deref;
use std::path::Path;

use slag_common::container::AlignedBytes;

/// The bytes of an immutable file, aligned for every column type.
#[derive(Debug)]
pub enum FileBytes {
    /// Mapped: pages are read on first access and dropped under memory pressure.
    Mapped(memmap2::Mmap),
    Read(AlignedBytes),
}

impl Deref for FileBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Mapped(map) => map,
            Self::Read(bytes) => bytes,
        }
    }
}

/// Maps a file opened for reading. `path`: for errors.
///
/// The file must not change any more: shards never do once renamed into place, and a staged file is mapped only after
/// its last write, by the holder of the cache's lock.
#[expect(unsafe_code, reason = "mapping a file is unsafe by nature; every other module is safe")]
pub fn map(file: &File, path: &Path) -> io::Result<FileBytes> {
    if file.metadata()?.len() == 0 {
        return Ok(FileBytes::Read(AlignedBytes::default()));
    }
    // SAFETY: the file is opened read-only and is immutable by this crate's protocol (new content gets a new
    // name, old names are only unlinked, and an unlinked file stays readable while mapped), so the bytes
    // behind the shared slice do not change. Another program could still truncate the file in place: access
    // to the lost pages then raises SIGBUS, which ends the process.
    let map = unsafe { memmap2::Mmap::map(file) };
    map.map(FileBytes::Mapped)
        .map_err(|e| io::Error::new(e.kind(), format!("mapping {}: {e}", path.display())))
}
