//! Where the bytes of a model's file are.

use std::{
    borrow::Cow,
    io,
    path::{Path, PathBuf},
};

/// A file of a model: on disk, or in the program itself.
#[derive(Clone, Debug)]
pub struct ModelFile {
    /// Its path, for people where it is in the program.
    pub path: PathBuf,
    embedded: Option<&'static [u8]>,
}

impl ModelFile {
    /// A file that is part of the program.
    pub(crate) fn embedded(path: &Path, bytes: &'static [u8]) -> Self {
        Self { path: Path::new("(embedded)").join(path), embedded: Some(bytes) }
    }

    /// Returns its bytes where it is part of the program.
    pub(crate) fn embedded_bytes(&self) -> Option<&'static [u8]> {
        self.embedded
    }

    /// Returns its bytes.
    ///
    /// # Errors
    /// The operating system's, with the path.
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
