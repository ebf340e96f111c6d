//! One pull: downloads and checks a model's files and records them in the lock.

use std::path::{Path, PathBuf};

use serde::Serialize;
use slag_common::durable;

use super::download::{Advertised, HubOptions, PartialFile, ask};
use super::error::{HubError, Source};
use super::lock::{Lock, LockedFile};
use super::table::{Entry, Table};
use crate::description::Sha256;
use crate::download::{Client, DownloadError, Part};
use crate::model_dir::hash_file;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    Text,
    Both,
}

/// A file that was pulled or already present.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PulledFile {
    /// Below the model's folder.
    pub path: String,
    pub sha256: Sha256,
    pub hash_source: Source,
    pub was_here: bool,
}

pub(super) struct Pull<'a> {
    pub(super) table: &'a Table,
    pub(super) options: &'a HubOptions,
    pub(super) folder: PathBuf,
    pub(super) entry: &'a Entry,
    pub(super) side: Side,
    pub(super) client: Client<'static>,
    pub(super) lock: Lock,
}

impl Pull<'_> {
    fn url(&self, path: &str) -> String {
        let hub = self.options.hub.as_deref().unwrap_or(&self.table.hub).trim_end_matches('/');
        let locked = self.lock.get(&self.entry.name).and_then(|accepted| accepted.revision.as_deref());
        let revision = self.entry.revision.as_deref().or(locked).unwrap_or("main");
        format!("{hub}/{}/resolve/{revision}/{path}", self.entry.repository)
    }

    pub(super) fn expected(&self, path: &str) -> Option<LockedFile> {
        let known = self.entry.known.get(path);
        let known = known.map(|known| LockedFile { sha256: known.sha256, hash_source: Source::Table });
        known.or_else(|| self.lock.get(&self.entry.name)?.files.get(path).cloned())
    }

    fn accept(&mut self, path: &str, file: LockedFile) -> Result<(), HubError> {
        self.lock.entry(&self.entry.name).files.insert(path.to_owned(), file);
        self.lock.write(&self.options.root)
    }

    fn unreachable(&self, url: &str, failure: DownloadError) -> HubError {
        if let DownloadError::Io(error) = failure {
            return HubError::Io(error);
        }
        let mut text = format!("{url}: {failure}; try again, or place these files by hand:");
        for path in self.entry.paths(self.side == Side::Text) {
            let target = self.folder.join(path);
            if !target.is_file() {
                let hash = self.expected(path).map_or("unknown".into(), |of| of.sha256.to_string());
                // A line per file; in one line they would be unreadable.
                text += &format!("\n  {}\n    as {} (SHA-256 {hash})", self.url(path), target.display());
            }
        }
        HubError::Other(text)
    }

    /// Requests a file's metadata, which must belong to the pulled commit.
    fn ask(&mut self, url: &str) -> Result<Advertised, HubError> {
        let advertised = ask(&self.client, url).map_err(|failure| self.unreachable(url, failure))?;
        if let Some(found) = advertised.revision.clone() {
            let accepted = self.lock.entry(&self.entry.name);
            match self.entry.revision.clone().or(accepted.revision.clone()) {
                Some(expected) if expected != found => {
                    return Err(HubError::Other(format!(
                        "{url}: the hub serves commit {found}, expected {expected}; give another --hub"
                    )));
                }
                _ => accepted.revision = Some(found),
            }
        }
        Ok(advertised)
    }

    /// Records the image model's hashes even if its files are not pulled: they are part of the encoder id.
    pub(super) fn name_image(&mut self) -> Result<(), HubError> {
        for path in self.entry.image_paths() {
            if self.expected(path).is_some() {
                continue;
            }
            let url = self.url(path);
            let fault = "the hub advertises no SHA-256 of the image model";
            let advice = "pull the whole model with slag-encoder";
            let sha256 = self.ask(&url)?.sha256;
            let sha256 = sha256.ok_or_else(|| HubError::Other(format!("{url}: {fault}; {advice}")))?;
            self.accept(path, LockedFile { sha256, hash_source: Source::Hub })?;
        }
        Ok(())
    }

    /// Downloads a file if it is absent, checks it, and records it in the lock.
    pub(super) fn file(&mut self, path: &str) -> Result<PulledFile, HubError> {
        let target = self.folder.join(path);
        let was_here = target.is_file();
        if !was_here {
            let accepted = self.download(path, &target)?;
            self.accept(path, accepted)?;
        }
        let found = Sha256(hash_file(&target)?);
        let expected = match self.expected(path) {
            Some(expected) => expected,
            // Placed by hand, without an expected hash.
            None => match ask(&self.client, &self.url(path)).ok().and_then(|advertised| advertised.sha256) {
                Some(sha256) => LockedFile { sha256, hash_source: Source::Hub },
                None => LockedFile { sha256: found, hash_source: Source::PlacedByHand },
            },
        };
        if found != expected.sha256 {
            return Err(expected.refusal(&target, found, "remove the file and pull again"));
        }
        self.accept(path, expected.clone())?;
        let LockedFile { sha256, hash_source } = expected;
        Ok(PulledFile { path: path.to_owned(), sha256, hash_source, was_here })
    }

    /// Returns the file's hash and the source of the expected hash.
    fn download(&mut self, path: &str, target: &Path) -> Result<LockedFile, HubError> {
        let url = self.url(path);
        let expected = self.expected(path);
        let advertised = self.ask(&url)?;
        if let (Some(expected), Some(advertised)) = (&expected, advertised.sha256)
            && expected.sha256 != advertised
        {
            let LockedFile { sha256, hash_source } = expected;
            return Err(HubError::Other(format!(
                "{url}: the hub advertises SHA-256 {advertised}, expected {sha256} ({hash_source}); do not use it, or \
                 take the model out of models.lock if you trust the new one"
            )));
        }
        let hub = advertised.sha256.map(|sha256| LockedFile { sha256, hash_source: Source::Hub });
        let stated = expected.or(hub);
        let part = PartialFile(target.with_added_extension("part"));
        fs_err::create_dir_all(target.parent().unwrap_or(&self.options.root))?;
        let len_bytes = self.entry.known.get(path).map(|known| known.len_bytes).or(advertised.len_bytes);
        tracing::info!("pulling {url}");
        loop {
            let received = part.receive(&self.client, &url, len_bytes);
            let was_begun = received.map_err(|failure| self.unreachable(&url, failure))?;
            let found = Sha256(hash_file(&part.0)?);
            let first = LockedFile { sha256: found, hash_source: Source::FirstPull };
            let expected = stated.clone().unwrap_or(first);
            if expected.sha256 == found {
                durable::move_into_place(&part.0, target)?;
                part.discard()?;
                return Ok(expected);
            }
            part.discard()?;
            // The part may belong to another version of the file: retry once from the start.
            if !was_begun {
                let advice = "the download was discarded: pull again, or give another --hub";
                return Err(expected.refusal(target, found, advice));
            }
        }
    }
}

/// The user's cache folder, `$XDG_CACHE_HOME/slag`, else `~/.cache/slag`; `variable` looks up environment variables.
pub fn cache_folder(variable: impl Fn(&str) -> Option<std::ffi::OsString>) -> Option<PathBuf> {
    // The XDG base directory specification ignores relative paths.
    let absolute = |name: &str| variable(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
    Some(base.join("slag"))
}

pub fn models_folder(cache_folder: &Path) -> PathBuf {
    cache_folder.join("models")
}
