//! The text side of a model in a store: files named by content, and a description in JSON with these names.

use serde_json::Value;
use slag_common::Hash32;

use crate::description::{Description, FileRef, Sha256};
use crate::file_ref::ModelFile;
use crate::{EncoderId, ModelError};

/// Licences that permit redistribution of weights, by SPDX name.
const REDISTRIBUTABLE: &str =
    "Apache-2.0, BSD-2-Clause, BSD-3-Clause, BSL-1.0, CC-BY-4.0, CC0-1.0, ISC, MIT, Unlicense, Zlib";

/// Why a store cannot carry a model's text side.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct TextSideError(pub(crate) String);

impl TextSideError {
    fn unlike(model: &str, what: impl std::fmt::Display) -> Self {
        Self(format!(
            "{model}: its description does not survive as JSON ({what}); report this with the model.toml"
        ))
    }
}

impl From<ModelError> for TextSideError {
    fn from(error: ModelError) -> Self {
        Self(error.0)
    }
}

/// The text side of a model: its files, and the description before these are renamed.
#[derive(Debug)]
pub struct TextSide {
    id: EncoderId,
    description: Value,
    files: Vec<TextFile>,
}

#[derive(Debug)]
struct TextFile {
    pointers: Vec<&'static str>,
    file: ModelFile,
    sha256: Sha256,
}

/// JSON pointer to the file of a role in a description.
fn pointer(role: &str) -> &'static str {
    match role {
        "image.model" => "/image/file",
        "text.tokenizer" => "/text/tokenizer",
        "text.vectors" => "/text/vectors",
        "text.centre" => "/text_centre/file",
        _ => "/text/file",
    }
}

/// Whether a licence expression is known to permit redistribution: every part joined by AND, or any joined by OR.
fn may_be_passed_on(licence: &str) -> bool {
    let is_known = |name: &str| {
        let name = name.trim_matches(['(', ')', ' ']);
        REDISTRIBUTABLE.split(", ").any(|known| known == name)
    };
    licence.split(" OR ").any(|part| part.split(" AND ").all(is_known))
}

impl TextSide {
    /// `document`: the description's TOML text; `hashed`: its parsed form, with the hash of every file; `open`:
    /// returns a file after checking its hash.
    pub(crate) fn new(
        id: &EncoderId,
        document: &str,
        hashed: &Description,
        open: impl Fn(&FileRef) -> Result<ModelFile, ModelError>,
    ) -> Result<Self, TextSideError> {
        let (model, licence) = (&hashed.name, &hashed.licence);
        if !may_be_passed_on(licence) {
            return Err(TextSideError(format!(
                "the licence of {model} is {licence:?}, which is not known to permit passing its weights on \
                 ({REDISTRIBUTABLE}); pull the model on each robot with `slag-edge models pull`, or correct `licence` in \
                 model.toml"
            )));
        }
        let other = |what: String| TextSideError::unlike(model, what);
        let table: toml::Table = toml::from_str(document).map_err(|e| other(e.to_string()))?;
        let mut description = serde_json::to_value(table).map_err(|e| other(e.to_string()))?;
        if let Some(fields) = description.as_object_mut() {
            // The files are in one folder.
            fields.remove("files_root");
        }
        let mut files: Vec<TextFile> = Vec::new();
        for (role, file) in hashed.files_by_role() {
            let Some(sha256) = file.sha256 else { return Err(other(format!("{role} has no hash"))) };
            let at = pointer(role);
            let named = description.pointer_mut(at).and_then(Value::as_object_mut);
            let named = named.ok_or_else(|| other(format!("{at} is missing")))?;
            named.insert("sha256".into(), sha256.to_string().into());
            if role == "image.model" {
                // It is not carried, but the encoder id needs its hashes.
                if let (Some(data), Some(Value::Object(named))) = (&file.data, named.get_mut("data")) {
                    named.insert("sha256".into(), data.sha256.map(|hash| hash.to_string()).into());
                }
                continue;
            }
            if file.data.is_some() {
                let fault = "its weights lie in a file of their own, which a store cannot carry; save the model as \
                             one file";
                return Err(ModelError::at(&file.path, fault).into());
            }
            match files.iter_mut().find(|known| known.sha256 == sha256) {
                Some(known) => known.pointers.push(at),
                None => files.push(TextFile { pointers: vec![at], file: open(file)?, sha256 }),
            }
        }
        Ok(Self { id: id.clone(), description, files })
    }

    /// Each once.
    pub fn files(&self) -> impl Iterator<Item = &ModelFile> {
        self.files.iter().map(|file| &file.file)
    }

    /// The description in JSON. `names`: BLAKE3 of each of [`Self::files`].
    pub fn description(&self, names: &[Hash32]) -> Result<Vec<u8>, TextSideError> {
        let mut description = self.description.clone();
        let other = |what: String| TextSideError::unlike(&self.id.name, what);
        for (TextFile { pointers, .. }, name) in self.files.iter().zip(names) {
            for at in pointers {
                let named = description.pointer_mut(at).ok_or_else(|| other(format!("{at} is missing")))?;
                named["path"] = name.to_string().into();
            }
        }
        let bytes = serde_json::to_vec(&description).map_err(|e| other(e.to_string()))?;
        let read = Description::from_json("text model".as_ref(), &bytes)?;
        match read.encoder_id() == self.id {
            true => Ok(bytes),
            false => Err(other("its encoder id changes".into())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_permissive_licences_are_passed_on() {
        for licence in
            ["MIT", "Apache-2.0", "apple-amlr OR MIT", "(MIT OR Apache-2.0)", "MIT AND BSD-3-Clause"]
        {
            assert!(may_be_passed_on(licence), "{licence}");
        }
        for licence in ["", "apple-amlr", "CC-BY-NC-4.0", "MIT AND apple-amlr", "mit-like", "unknown"] {
            assert!(!may_be_passed_on(licence), "{licence}");
        }
    }
}
