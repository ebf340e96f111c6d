//! Errors of the splat readers, and the places they name.

use std::error::Error;
use std::fmt::{self, Display};
use std::io;
use std::path::{Path, PathBuf};

use crate::files::NotUtf8;

#[derive(Debug, thiserror::Error)]
pub enum SplatError {
    #[error("{cause}; check the path and its permissions")]
    Io { cause: io::Error },
    #[error("{}: {place}: expected {expected}, found {found}; {advice}", path.display())]
    Malformed { path: PathBuf, place: Place, expected: String, found: String, advice: &'static str },
    #[error("{}: {place}: {what} cannot be decompressed: {cause}; copy or export the file again", path.display())]
    Undecodable { path: PathBuf, place: Place, what: &'static str, cause: Box<dyn Error + Send + Sync> },
    #[error("{}: {place}: {fault}", path.display())]
    Text { path: PathBuf, place: Place, fault: NotUtf8 },
    #[error("{}: {format} is not supported; {advice}", path.display())]
    Unsupported { path: PathBuf, format: String, advice: &'static str },
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// An offset in the file, bytes.
    Byte(u64),
    /// An offset in the decompressed content, bytes.
    DecompressedByte(u64),
    /// A line, from 1.
    Line(u64),
    /// A file of a bundle or folder.
    Part(String),
}

impl Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Byte(offset) => write!(f, "byte {offset}"),
            Self::DecompressedByte(offset) => write!(f, "byte {offset} of the decompressed data"),
            Self::Line(line) => write!(f, "line {line}"),
            Self::Part(name) => write!(f, "{name}"),
        }
    }
}

const COPY_AGAIN: &str = "the file is damaged or incomplete: copy or export it again";

impl From<io::Error> for SplatError {
    fn from(cause: io::Error) -> Self {
        Self::Io { cause }
    }
}

impl SplatError {
    /// Returns a [`SplatError::Malformed`] that advises to copy or export the file again.
    pub(super) fn malformed(path: &Path, place: Place, expected: impl Display, found: impl Display) -> Self {
        Self::Malformed {
            path: path.into(),
            place,
            expected: expected.to_string(),
            found: found.to_string(),
            advice: COPY_AGAIN,
        }
    }

    pub(super) fn undecodable(
        path: &Path,
        place: Place,
        what: &'static str,
        cause: impl Into<Box<dyn Error + Send + Sync>>,
    ) -> Self {
        Self::Undecodable { path: path.into(), place, what, cause: cause.into() }
    }
}
