//! A worker's folder for one run: photos in work. It goes with the run; what killed workers left goes when the
//! next one begins, which knows them by their locks: a lock ends with its process, however that ends.

use std::fs::File;
use std::path::{Path, PathBuf};

use super::error::FleetError;

/// Names of folders begin so. The process's number follows, which says little: workers of other machines and
/// containers may share the parent.
const PREFIX: &str = "slag-worker-";

/// The file in each folder that its worker holds locked.
const LOCK: &str = "lock";

pub(super) struct RunFolder {
    path: PathBuf,
    _lock: File,
}

impl RunFolder {
    /// Makes a folder under `parent`, and removes those that killed workers left there.
    pub(super) fn make(parent: &Path) -> Result<Self, FleetError> {
        fs_err::create_dir_all(parent)?;
        remove_left(parent);
        let name = format!("{PREFIX}{}-", std::process::id());
        // Hidden until it is locked: another worker that begins now would take it for a left one.
        let hidden = tempfile::Builder::new().prefix(&format!(".{name}")).tempdir_in(parent)?;
        let lock = File::create_new(hidden.path().join(LOCK))?;
        lock.lock()?;
        let hidden_name = hidden.path().file_name().unwrap_or_default().to_string_lossy().into_owned();
        let path = parent.join(hidden_name.trim_start_matches('.'));
        fs_err::rename(hidden.keep(), &path)?;
        Ok(Self { path, _lock: lock })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        if let Err(error) = fs_err::remove_dir_all(&self.path) {
            tracing::warn!("{error}");
        }
    }
}

/// Removes the folders whose workers are gone. What cannot be looked at is left alone.
fn remove_left(parent: &Path) {
    let Ok(entries) = fs_err::read_dir(parent) else { return };
    for entry in entries.flatten() {
        let path = entry.path();
        if !entry.file_name().to_string_lossy().starts_with(PREFIX) {
            continue;
        }
        let Ok(lock) = File::options().write(true).open(path.join(LOCK)) else { continue };
        if lock.try_lock().is_ok() {
            tracing::info!("{}: removed; a worker that was killed left it", path.display());
            if let Err(error) = fs_err::remove_dir_all(&path) {
                tracing::warn!("{error}");
            }
        }
    }
}

#[cfg(test)]
mod tests;
