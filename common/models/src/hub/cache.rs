//! Models of the table, and those in the user's cache.

use std::path::{Path, PathBuf};

use serde::Serialize;
use slag_common::durable;

use super::download::{HubOptions, client};
use super::error::HubError;
use super::lock::Lock;
use super::pull::{Pull, PulledFile, Side};
use super::table::{Entry, Table, files_of};
use crate::ModelError;
use crate::description::{self, Sha256};
use crate::model_dir::{hash_file, other_hash};

/// The part of a model that is in the cache.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Here {
    /// Nothing usable.
    No,
    Text,
    All,
}

#[derive(Debug)]
pub struct Hub {
    table: Table,
    options: HubOptions,
}

impl Hub {
    pub fn new(options: HubOptions) -> Self {
        Self { table: Table::embedded(), options }
    }

    pub fn with_table(table: Table, options: HubOptions) -> Self {
        Self { table, options }
    }

    pub fn table(&self) -> &Table {
        &self.table
    }

    pub fn folder(&self, entry: &Entry) -> PathBuf {
        self.options.root.join(&entry.name)
    }

    pub fn entry(&self, name: &str) -> Result<&Entry, HubError> {
        self.table.find(name).ok_or_else(|| {
            let known: Vec<&str> = self.table.models.iter().map(|entry| entry.name.as_str()).collect();
            HubError::Other(format!(
                "unknown model {name:?}; there are {}: choose one, or give the folder of your own model",
                known.join(", ")
            ))
        })
    }

    /// Returns the part of a model that is in the cache, without reading files.
    pub fn here(&self, entry: &Entry) -> Here {
        let folder = self.folder(entry);
        if entry.export.is_some() {
            return if folder.join(description::FILE_NAME).is_file() { Here::All } else { Here::No };
        }
        let has = |text_only| entry.paths(text_only).iter().all(|path| folder.join(path).is_file());
        match folder.join(description::FILE_NAME).is_file() && has(true) {
            false => Here::No,
            true if has(false) => Here::All,
            true if entry.is_segmenter() => Here::No,
            true => Here::Text,
        }
    }

    /// Pulls the missing files of a model and writes its `model.toml`.
    ///
    /// Only one pull runs at a time; others wait. An interrupted pull leaves complete files, and partial ones for
    /// the next pull to resume.
    /// # Errors
    /// [`HubError`]; [`HubError::Licence`] if the licence restricts use and was not accepted, now or earlier.
    pub fn pull(&self, name: &str, side: Side, accepts_licence: bool) -> Result<Vec<PulledFile>, HubError> {
        let entry = self.entry(name)?;
        let root = &self.options.root;
        if let Some(script) = &entry.export {
            let (repository, folder) = (&entry.repository, self.folder(entry));
            return Err(HubError::Other(format!(
                "{name}: {repository} publishes weights, but no ONNX files; make them with `{script} {}` where PyTorch \
                 and the hub can be reached, then use the model by its name",
                folder.display()
            )));
        }
        if side == Side::Text && entry.is_segmenter() {
            let fault = "finds masks in photos, which a robot does not do; pull it with slag-encoder";
            return Err(HubError::Other(format!("{name} {fault}")));
        }
        let mut lock = Lock::read(root)?;
        let was_accepted = lock.get(name).is_some_and(|accepted| accepted.licence == entry.licence);
        if entry.restricts_use && !was_accepted && !accepts_licence {
            return Err(HubError::Licence {
                name: name.to_owned(),
                licence: entry.licence.clone(),
                url: entry.licence_url.clone(),
                note: entry.licence_note.clone(),
            });
        }
        fs_err::create_dir_all(root)?;
        let guard = fs_err::File::create(root.join(".pull"))?;
        guard.file().lock()?;
        // Another pull may have changed it.
        lock = Lock::read(root)?;
        lock.entry(name).licence.clone_from(&entry.licence);
        let client = client(&self.options).map_err(|fault| {
            HubError::Other(format!("the proxy in HTTPS_PROXY: {fault}; correct or unset it"))
        })?;
        let mut pull = Pull {
            table: &self.table,
            options: &self.options,
            folder: self.folder(entry),
            entry,
            side,
            client,
            lock,
        };
        let paths = entry.paths(side == Side::Text);
        let pulled = paths.into_iter().map(|path| pull.file(path)).collect::<Result<Vec<_>, _>>()?;
        pull.name_image()?;
        let hash_of = |path: &str| Some(pull.expected(path)?.sha256);
        let description = self.table.description(entry, &hash_of);
        durable::write(&self.folder(entry).join(description::FILE_NAME), description.as_bytes())?;
        Ok(pulled)
    }

    /// Compares the hash of every file with the recorded one.
    pub fn verify(folder: &Path) -> Result<Vec<String>, HubError> {
        let (root, files) = files_of(folder)?;
        let mut verified = Vec::new();
        for (role, file) in files {
            let path = root.join(&file.path);
            // Robots have only the text side.
            if role == "image.model" && file.sha256.is_some() && !path.exists() {
                continue;
            }
            let found = hash_file(&path).map_err(|cause| ModelError::unreadable(&cause))?;
            if let Some(expected) = file.sha256.filter(|expected| expected.0 != found) {
                return Err(other_hash(&path, expected, Sha256(found)).into());
            }
            verified.push(file.path.display().to_string());
        }
        Ok(verified)
    }

    /// Returns `name` if it has a `model.toml` or is not in the table, else the pulled model's folder.
    pub fn resolve(&self, name: &Path) -> Result<PathBuf, HubError> {
        let entry = name.to_str().and_then(|name| self.table.find(name));
        match entry {
            // A folder without a model does not hide the name.
            Some(entry) if !name.join(description::FILE_NAME).is_file() => match self.here(entry) {
                Here::No => {
                    let advice =
                        format!("run `models pull {}`, or give the folder of your own model", entry.name);
                    Err(HubError::Other(format!("{} is not pulled yet; {advice}", entry.name)))
                }
                _ => Ok(self.folder(entry)),
            },
            _ => Ok(name.to_owned()),
        }
    }
}
