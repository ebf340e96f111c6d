//! Files of a model, by path and SHA-256.

use std::borrow::Cow;
use std::fmt;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use serde::ser::{Error as _, Serializer};
use serde::{Deserialize, Serialize};
use slag_common::files;

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileRef {
    /// Below `files_root`.
    pub path: PathBuf,
    pub sha256: Option<Sha256>,
    /// Weights that an ONNX file keeps in a separate file (`.onnx_data`), which it names relative to its own folder.
    #[serde(default)]
    pub data: Option<Box<FileRef>>,
}

impl FileRef {
    /// The file and, if separate, its weights.
    pub fn parts(&self) -> impl Iterator<Item = &Self> {
        std::iter::successors(Some(self), |file| file.data.as_deref())
    }
}

/// Only the hashes: the encoder id must not depend on paths.
impl Serialize for FileRef {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let sha256 =
            self.sha256.ok_or_else(|| S::Error::custom(format!("{}: no hash", self.path.display())))?;
        match &self.data {
            None => sha256.serialize(serializer),
            Some(data) => (sha256, data).serialize(serializer),
        }
    }
}

/// A SHA-256, as 64 hexadecimal digits in text.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Sha256(pub [u8; 32]);

impl fmt::Display for Sha256 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&hex::encode(self.0))
    }
}

impl From<Sha256> for String {
    fn from(sha256: Sha256) -> Self {
        sha256.to_string()
    }
}

impl TryFrom<String> for Sha256 {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let mut bytes = [0; 32];
        hex::decode_to_slice(&text, &mut bytes)
            .map(|()| Self(bytes))
            .map_err(|error| format!("{text:?} is not a SHA-256 of 64 hexadecimal digits: {error}"))
    }
}

/// A file of a model: on disk, or embedded in the program.
#[derive(Clone, Debug)]
pub struct ModelFile {
    /// For messages only if it is embedded.
    pub path: PathBuf,
    pub(crate) embedded: Option<&'static [u8]>,
}

impl ModelFile {
    pub(crate) fn embedded(path: &Path, bytes: &'static [u8]) -> Self {
        Self { path: Path::new("(embedded)").join(path), embedded: Some(bytes) }
    }

    pub fn reader(&self) -> io::Result<Box<dyn Read>> {
        Ok(match self.embedded {
            Some(bytes) => Box::new(bytes),
            None => Box::new(files::open(&self.path)?),
        })
    }

    pub fn read(&self) -> io::Result<Cow<'static, [u8]>> {
        match self.embedded {
            Some(bytes) => Ok(Cow::Borrowed(bytes)),
            None => fs_err::read(&self.path).map(Cow::Owned),
        }
    }
}

impl<P: Into<PathBuf>> From<P> for ModelFile {
    fn from(path: P) -> Self {
        Self { path: path.into(), embedded: None }
    }
}
