//! The models of the table, and those of them in the user's cache.

use std::io;
use std::path::{Path, PathBuf};

use serde::Serialize;
use slag_common::durable;

use super::download::Client;
use super::error::HubError;
use super::lock::Lock;
use super::options::HubOptions;
use super::pull::{Pull, PulledFile, Side};
use super::table::{Entry, Table};
use crate::description::{self, Description, DescriptionError, Sha256};
use crate::model_dir::hash_file;

/// What of a model is here.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Here {
    /// Nothing that can be used.
    No,
    /// What texts need.
    Text,
    /// All.
    All,
}

/// The models of the table and those in a folder.
#[derive(Debug)]
pub struct Hub {
    table: Table,
    options: HubOptions,
}

impl Hub {
    /// Returns the hub's table over the folder of `options`.
    /// # Errors
    /// [`HubError::Table`], which a test rules out.
    pub fn new(options: HubOptions) -> Result<Self, HubError> {
        Ok(Self { table: Table::embedded()?, options })
    }

    /// Returns the same with another table.
    pub fn with_table(table: Table, options: HubOptions) -> Self {
        Self { table, options }
    }

    /// Returns the models known.
    pub fn table(&self) -> &Table {
        &self.table
    }

    /// Returns the folder of a model of the table.
    pub fn folder(&self, entry: &Entry) -> PathBuf {
        self.options.root.join(&entry.name)
    }

    /// Returns a model of the table.
    /// # Errors
    /// [`HubError::Unknown`] where it has none of that name.
    pub fn entry(&self, name: &str) -> Result<&Entry, HubError> {
        let known = || self.table.models.iter().map(|entry| entry.name.clone()).collect();
        self.table.find(name).ok_or_else(|| HubError::Unknown { name: name.to_owned(), known: known() })
    }

    /// Says what of a model is here; files are looked for, not read.
    pub fn here(&self, entry: &Entry) -> Here {
        let folder = self.folder(entry);
        let has = |text_only| entry.paths(text_only).iter().all(|path| folder.join(path).is_file());
        match folder.join(description::FILE_NAME).is_file() && has(true) {
            false => Here::No,
            true if has(false) => Here::All,
            true => Here::Text,
        }
    }

    /// Pulls what of a model is not here, and writes its `model.toml`.
    ///
    /// Two pulls at a time wait for each other. Cut off at any moment, a pull leaves whole files and parts to go
    /// on with.
    /// # Errors
    /// [`HubError`]; [`HubError::Licence`] where the licence is neither accepted now nor was before.
    pub fn pull(&self, name: &str, side: Side, accepts_licence: bool) -> Result<Vec<PulledFile>, HubError> {
        let entry = self.entry(name)?;
        let root = &self.options.root;
        let mut lock = Lock::read(root)?;
        let was_accepted = lock.get(name).is_some_and(|accepted| accepted.licence == entry.licence);
        if !was_accepted && !accepts_licence {
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
        // Another pull may have ended meanwhile.
        lock = Lock::read(root)?;
        lock.entry(name).licence.clone_from(&entry.licence);
        let client = Client::new(&self.options)?;
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

    /// Reads every file that is here of a model, and compares its hash with the recorded one.
    /// # Errors
    /// [`HubError`] where a file is absent that texts need, or not the recorded one.
    pub fn verify(folder: &Path) -> Result<Vec<String>, HubError> {
        let description = Description::read(&folder.join(description::FILE_NAME))?;
        let root = folder.join(&description.files_root);
        let mut verified = Vec::new();
        for (role, file) in description.files() {
            let path = root.join(&file.path);
            // A robot has the text side alone.
            if role == "image.model" && file.sha256.is_some() && !path.exists() {
                continue;
            }
            let found = hash_file(&path).map_err(|cause| DescriptionError::Read { cause })?;
            if let Some(expected) = file.sha256.filter(|expected| expected.0 != found) {
                let (expected, found) = (expected.to_string(), Sha256(found).to_string());
                return Err(DescriptionError::Hash { path, expected, found }.into());
            }
            verified.push(file.path.display().to_string());
        }
        Ok(verified)
    }

    /// Returns the folder that `name` stands for: that of a pulled model, where it is the name of one and no
    /// folder with a `model.toml`, else `name` itself.
    /// # Errors
    /// [`HubError::NotPulled`] where it is a model of the table and not here.
    pub fn resolve(&self, name: &Path) -> Result<PathBuf, HubError> {
        let entry = name.to_str().and_then(|name| self.table.find(name));
        match entry {
            // A name is a name even where the working folder has one of that name without a model in it.
            Some(entry) if !name.join(description::FILE_NAME).is_file() => match self.here(entry) {
                Here::No => {
                    let advice =
                        format!("{} is not pulled yet: `models pull {}` does", entry.name, entry.name);
                    Err(HubError::Io(io::Error::new(io::ErrorKind::NotFound, advice)))
                }
                _ => Ok(self.folder(entry)),
            },
            _ => Ok(name.to_owned()),
        }
    }
}
