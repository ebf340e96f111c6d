//! A worker's folder for one run: photos in work. It goes with the run; what killed workers left goes when the next one
//! begins, which knows them by their locks: a lock ends with its process, however that ends.

use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::error::FleetError;
use super::run::Run;

/// Names of folders begin so. The process's number follows, which says little: workers of other machines and containers may share
/// the parent.
const PREFIX: &str = "slag-worker-";

/// The file in each folder that its worker holds locked.
const LOCK: &str = "lock";

/// A folder that goes with the run.
pub(super) struct RunFolder {
    path: PathBuf,
    _lock: File,
}

impl RunFolder {
    /// Makes a folder for a run under `parent`, and removes those that killed workers left there.
    pub(super) fn make(parent: &Path, run: Run) -> Result<Self, FleetError> {
        fs_err::create_dir_all(parent)?;
        remove_left(parent);
        for attempt in 0.. {
            let name = format!("{PREFIX}{}-{}-{attempt}", std::process::id(), run.0);
            // Under its name only once it is locked: another worker that begins now would take it for a left one.
            let (hidden, path) = (parent.join(format!(".{name}")), parent.join(name));
            let is_taken = |error: &std::io::Error| {
                matches!(error.kind(), ErrorKind::AlreadyExists | ErrorKind::DirectoryNotEmpty)
            };
            match fs_err::create_dir(&hidden) {
                Err(error) if is_taken(&error) => continue,
                made => made?,
            }
            let lock = File::create_new(hidden.join(LOCK))?;
            lock.lock()?;
            match fs_err::rename(&hidden, &path) {
                Err(error) if is_taken(&error) => fs_err::remove_dir_all(&hidden)?,
                renamed => return renamed.map(|()| Self { path, _lock: lock }).map_err(FleetError::Io),
            }
        }
        unreachable!("attempts do not end")
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
mod tests {
    use super::*;

    /// A folder lives as long as its worker; what a killed worker left goes with the next one, and nothing else does.
    #[test]
    fn folders_go_with_their_workers() {
        let dir = tempfile::tempdir().expect("a folder");
        let scratch = dir.path().join("scratch");
        let names = || {
            let entries = fs_err::read_dir(&scratch).expect("reads");
            let mut names: Vec<_> = entries.map(|entry| entry.expect("reads").path()).collect();
            names.sort();
            names
        };
        let first = RunFolder::make(&scratch, Run(1)).expect("made");
        fs_err::create_dir_all(first.path().join("photos")).expect("made");
        fs_err::write(first.path().join("photos/a.png"), "a").expect("written");
        // As a killed worker leaves it, and as neighbours have theirs.
        let left = scratch.join("slag-worker-left-1");
        fs_err::create_dir_all(left.join("photos")).expect("made");
        fs_err::write(left.join(LOCK), "").expect("written");
        let foreign = [scratch.join("photos"), scratch.join("slag-worker-without-a-lock")];
        foreign.iter().for_each(|path| fs_err::create_dir_all(path).expect("made"));

        let second = RunFolder::make(&scratch, Run(1)).expect("made");
        assert_ne!(first.path(), second.path());
        let mut expected = vec![first.path().to_owned(), second.path().to_owned()];
        expected.extend(foreign.clone());
        expected.sort();
        assert_eq!(names(), expected);
        drop((first, second));
        assert_eq!(names(), foreign);
    }
}
