//! The table of public models, kept as data in `models.toml`.

use std::collections::BTreeMap;

use serde::Deserialize;

use crate::description::Sha256;

/// The contents of `models.toml`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Table {
    /// Address of the hub.
    pub hub: String,
    layout: BTreeMap<String, Layout>,
    /// The models.
    #[serde(rename = "model")]
    pub models: Vec<Entry>,
}

/// The common part of all models of one kind of export.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Layout {
    /// The end of a `model.toml`, with IMAGE, TEXT and TOKENIZER in place of the files.
    description: String,
}

/// A public model.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Its name, here and in `model.toml`.
    pub name: String,
    /// A description for people.
    pub about: String,
    layout: String,
    dim: u32,
    /// The licence of the weights.
    pub licence: String,
    /// Remarks on the licence.
    #[serde(default)]
    pub licence_note: String,
    /// Address of the licence.
    pub licence_url: String,
    /// Owner and name at the hub.
    pub repository: String,
    /// The commit; default: that of the first pull.
    pub revision: Option<String>,
    image: String,
    text: String,
    tokenizer: String,
    /// Known lengths and hashes of files, by path.
    #[serde(default)]
    pub known: BTreeMap<String, Known>,
}

/// The known length and hash of a file.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Known {
    /// Its length.
    pub len_bytes: u64,
    /// Its SHA-256.
    pub sha256: Sha256,
}

impl Entry {
    /// Returns the files' paths, image first; `text_only`: without the image model.
    pub fn paths(&self, text_only: bool) -> Vec<&str> {
        let all = [self.image.as_str(), self.text.as_str(), self.tokenizer.as_str()];
        all[usize::from(text_only)..].to_vec()
    }
}

impl Table {
    /// Returns the table in the program.
    /// # Errors
    /// If it does not parse, which a test rules out.
    pub fn embedded() -> Result<Self, Box<toml::de::Error>> {
        toml::from_str(include_str!("../../models.toml")).map_err(Box::new)
    }

    /// Returns the entry called `name`.
    pub fn find(&self, name: &str) -> Option<&Entry> {
        self.models.iter().find(|entry| entry.name == name)
    }

    /// Returns the `model.toml` of `entry`, with the hashes of its files.
    pub fn description(&self, entry: &Entry, sha256_of: &dyn Fn(&str) -> Option<Sha256>) -> String {
        // Plain ASCII text, which Rust and TOML quote alike.
        let quoted = |text: &str| format!("{text:?}");
        let head = format!(
            "name = {}\nabout = {}\ndim = {}\nlicence = {}\n",
            quoted(&entry.name),
            quoted(&entry.about),
            entry.dim,
            quoted(&entry.licence)
        );
        let body = self.layout.get(&entry.layout).map_or("", |layout| layout.description.as_str());
        let placeholders = [("IMAGE", &entry.image), ("TEXT", &entry.text), ("TOKENIZER", &entry.tokenizer)];
        placeholders.into_iter().fold(head + body, |text, (placeholder, path)| {
            let hash = sha256_of(path).map_or(String::new(), |sha256| format!(", sha256 = \"{sha256}\""));
            text.replace(&format!("path = \"{placeholder}\""), &format!("path = {}{hash}", quoted(path)))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::description::Description;

    /// Every entry has a valid description, a unique name, and hashes of its own files only.
    #[test]
    fn every_entry_can_be_pulled() {
        let table = Table::embedded().expect("it parses");
        assert!(table.hub.starts_with("https://"));
        let folder = tempfile::tempdir().expect("a folder");
        for entry in &table.models {
            let name = &entry.name;
            assert_eq!(table.models.iter().filter(|other| other.name == *name).count(), 1, "{name}");
            assert!(entry.licence_url.starts_with("https://") && !entry.licence.is_empty(), "{name}");
            assert!(entry.revision.iter().all(|r| r.len() == 40), "{name}");
            assert!(entry.known.keys().all(|path| entry.paths(false).contains(&path.as_str())), "{name}");
            let path = folder.path().join("model.toml");
            let hash = Sha256([7; 32]);
            fs_err::write(&path, table.description(entry, &|_| Some(hash))).expect("it is writable");
            let description = Description::read(&path).expect(name);
            assert_eq!(&description.name, name);
            let files: Vec<_> = description.files().into_iter().map(|(_, file)| file.clone()).collect();
            assert!(files.iter().all(|file| file.sha256 == Some(hash)), "{name}");
            let paths: Vec<_> = files.iter().map(|file| file.path.to_str().expect("UTF-8")).collect();
            assert_eq!(paths, entry.paths(false), "{name}");
        }
    }
}
