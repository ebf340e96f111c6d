//! Model files on disk or in the program.

use std::{
    borrow::Cow,
    io::{self, Read},
    path::{Path, PathBuf},
};

/// A file of a model: on disk, or embedded in the program.
#[derive(Clone, Debug)]
pub struct ModelFile {
    /// Its path; for messages only if it is embedded.
    pub path: PathBuf,
    embedded: Option<&'static [u8]>,
}

impl ModelFile {
    pub(crate) fn embedded(path: &Path, bytes: &'static [u8]) -> Self {
        Self { path: Path::new("(embedded)").join(path), embedded: Some(bytes) }
    }

    pub(crate) fn embedded_bytes(&self) -> Option<&'static [u8]> {
        self.embedded
    }

    /// Opens it for reading from its start.
    pub fn reader(&self) -> io::Result<Box<dyn Read>> {
        Ok(match self.embedded {
            Some(bytes) => Box::new(bytes),
            None => Box::new(fs_err::File::open(&self.path)?),
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
