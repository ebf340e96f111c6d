//! Paths of pose files.

use std::io;
use std::path::{Path, PathBuf};

/// Returns the parent folder of `path`, also for paths such as `.` that do not name it.
pub(super) fn parent(path: &Path) -> io::Result<PathBuf> {
    match path.parent() {
        Some(parent) if path.file_name().is_some() && parent != Path::new("") => Ok(parent.to_owned()),
        _ => Ok(fs_err::canonicalize(path)?.parent().map_or_else(|| PathBuf::from("/"), Path::to_owned)),
    }
}
