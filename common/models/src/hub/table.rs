//! The table of public models, kept as data in `models.toml`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::ModelError;
use crate::description::{Description, FILE_NAME, FileRef, Sha256, read_toml};
use crate::sam::SamDescription;

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Table {
    pub hub: String,
    layout: BTreeMap<String, Layout>,
    #[serde(rename = "model")]
    pub models: Vec<Entry>,
}

/// What all models of one kind of export share.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Layout {
    /// The end of a `model.toml`, with roles in capitals as file paths.
    description: String,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Also the name in `model.toml`.
    pub name: String,
    /// For people.
    pub about: String,
    layout: String,
    /// Dimension of vectors; segmenters have none.
    dim: Option<u32>,
    pub licence: String,
    #[serde(default)]
    pub licence_note: String,
    pub licence_url: String,
    /// Whether the licence restricts use (research only, for example) and must be accepted.
    #[serde(default)]
    pub restricts_use: bool,
    /// Owner and name at the hub.
    pub repository: String,
    /// A commit; default: that of the first pull.
    pub revision: Option<String>,
    /// Script that makes the files from published weights where no export is published; nothing can be pulled then.
    pub export: Option<String>,
    /// Files at the hub by role: `image`, `text` and `tokenizer`, or `image_encoder` and `mask_decoder`.
    #[serde(default)]
    files: BTreeMap<String, String>,
    /// Separate files of weights, by the same roles.
    #[serde(default)]
    data: BTreeMap<String, String>,
    /// Known lengths and hashes of files, by path.
    #[serde(default)]
    pub known: BTreeMap<String, Known>,
}

/// Roles of files, in the order of their pull; a robot needs those from [`FIRST_OF_TEXT`].
const ROLES: [&str; 5] = ["image_encoder", "mask_decoder", "image", "text", "tokenizer"];
const FIRST_OF_TEXT: usize = 3;

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Known {
    pub len_bytes: u64,
    pub sha256: Sha256,
}

impl Entry {
    /// Paths of the files, image side first, each followed by its weights; `text_only` omits the image side.
    pub fn paths(&self, text_only: bool) -> Vec<&str> {
        let roles = &ROLES[if text_only { FIRST_OF_TEXT } else { 0 }..];
        let parts = |role: &&str| [self.files.get(*role), self.data.get(*role)];
        roles.iter().flat_map(parts).flatten().map(String::as_str).collect()
    }

    /// Paths of the image model: the ONNX file, then its separate weights. Empty without one.
    pub(super) fn image_paths(&self) -> Vec<&str> {
        [self.files.get("image"), self.data.get("image")].into_iter().flatten().map(String::as_str).collect()
    }

    pub fn is_segmenter(&self) -> bool {
        self.files.contains_key("mask_decoder")
    }
}

impl Table {
    pub fn embedded() -> Self {
        toml::from_str(include_str!("../../models.toml")).expect("a test reads it")
    }

    pub fn find(&self, name: &str) -> Option<&Entry> {
        self.models.iter().find(|entry| entry.name == name)
    }

    /// Returns the `model.toml` of `entry`, with the hashes of its files.
    pub fn description(&self, entry: &Entry, sha256_of: &dyn Fn(&str) -> Option<Sha256>) -> String {
        // Plain ASCII, which Rust and TOML quote alike.
        let quoted = |text: &str| format!("{text:?}");
        let dim = entry.dim.map_or(String::new(), |dim| format!("dim = {dim}\n"));
        let head = format!(
            "name = {}\nabout = {}\n{dim}licence = {}\n",
            quoted(&entry.name),
            quoted(&entry.about),
            quoted(&entry.licence)
        );
        let part = |path: &str| {
            let hash = sha256_of(path).map_or(String::new(), |sha256| format!(", sha256 = \"{sha256}\""));
            format!("path = {}{hash}", quoted(path))
        };
        let body = self.layout.get(&entry.layout).map_or("", |layout| layout.description.as_str());
        entry.files.iter().fold(head + body, |text, (role, path)| {
            let data =
                entry.data.get(role).map_or(String::new(), |data| format!(", data = {{ {} }}", part(data)));
            text.replace(&format!("path = {:?}", role.to_uppercase()), &format!("{}{data}", part(path)))
        })
    }
}

type Files = Vec<(&'static str, FileRef)>;

/// Folder of a model's files, and these with their roles; a segmenter's description has `[segment]`.
pub(super) fn files_of(folder: &Path) -> Result<(PathBuf, Files), ModelError> {
    let path = folder.join(FILE_NAME);
    let owned = |files: Vec<(&'static str, &FileRef)>| {
        files.into_iter().map(|(role, file)| (role, file.clone())).collect()
    };
    Ok(match read_toml::<toml::Table>(&path)?.contains_key("segment") {
        true => {
            let segmenter = SamDescription::read(&path)?;
            (folder.join(&segmenter.files_root), owned(segmenter.files()))
        }
        false => {
            let encoders = Description::read(&path)?;
            (folder.join(&encoders.files_root), owned(encoders.files()))
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    /// Every entry has a valid description, a unique name, and no hashes of foreign files.
    #[test]
    fn every_entry_can_be_pulled() {
        let table = Table::embedded();
        assert!(table.hub.starts_with("https://"));
        let folder = tempfile::tempdir().expect("a folder");
        for entry in &table.models {
            let name = &entry.name;
            assert_eq!(table.models.iter().filter(|other| other.name == *name).count(), 1, "{name}");
            assert!(entry.licence_url.starts_with("https://") && !entry.licence.is_empty(), "{name}");
            assert!(entry.revision.iter().all(|r| r.len() == 40), "{name}");
            assert!(entry.known.keys().all(|path| entry.paths(false).contains(&path.as_str())), "{name}");
            let roles = entry.files.keys().chain(entry.data.keys());
            assert!(roles.into_iter().all(|role| ROLES.contains(&role.as_str())), "{name}");
            if entry.export.is_some() {
                assert!(entry.files.is_empty(), "{name}");
                continue;
            }
            let path = folder.path().join("model.toml");
            let hash = Sha256([7; 32]);
            fs_err::write(&path, table.description(entry, &|_| Some(hash))).expect("it is writable");
            let (_, files) = files_of(folder.path()).expect(name);
            assert!(files.iter().all(|(_, file)| file.sha256 == Some(hash)), "{name}");
            let paths: Vec<_> = files.iter().map(|(_, file)| file.path.to_str().expect("UTF-8")).collect();
            assert_eq!(paths, entry.paths(false), "{name}");
        }
    }
}
