//! Names and bytes of manifests, as they lie on disk.

use std::io::{self, Read};
use std::path::Path;

use slag_common::manifest::{self, ManifestError};

use super::error::StoreError;

/// The current manifest.
pub(super) const MANIFEST: &str = "manifest";
/// The one before it, which fetches in progress may still need.
pub(super) const MANIFEST_PREVIOUS: &str = "manifest.previous";

/// Reads a manifest's bytes; `None` if there is no such file.
pub(super) fn read_bytes(path: &Path) -> Result<Option<Vec<u8>>, StoreError> {
    let file = match fs_err::File::open(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file?,
    };
    let mut bytes = Vec::new();
    file.take(manifest::MAX_BYTES + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > manifest::MAX_BYTES {
        let cause = ManifestError::TooLong { len_bytes: bytes.len() as u64 };
        return Err(StoreError::Manifest { path: path.to_owned(), cause });
    }
    Ok(Some(bytes))
}
