//! The error of the splat readers.

use std::fmt::Display;
use std::io;
use std::path::Path;

/// Why a splat is not read: the file, the place of the fault, what was expected and found, and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct SplatError(String);

impl From<io::Error> for SplatError {
    fn from(cause: io::Error) -> Self {
        Self(format!("{cause}; check the path and its permissions"))
    }
}

impl SplatError {
    pub(super) fn at(path: &Path, place: impl Display, fault: impl Display) -> Self {
        Self(format!("{}: {place}: {fault}", path.display()))
    }

    /// Advises to copy or export the file again.
    pub(super) fn malformed(
        path: &Path,
        place: impl Display,
        expected: impl Display,
        found: impl Display,
    ) -> Self {
        let advice = "the file is damaged or incomplete: copy or export it again";
        Self::at(path, place, format_args!("expected {expected}, found {found}; {advice}"))
    }

    pub(super) fn undecodable(path: &Path, place: impl Display, what: &str, cause: impl Display) -> Self {
        let advice = "copy or export the file again";
        Self::at(path, place, format_args!("{what} cannot be decompressed: {cause}; {advice}"))
    }

    pub(super) fn unsupported(path: &Path, format: impl Display, advice: &str) -> Self {
        Self(format!("{}: {format} is not supported; {advice}", path.display()))
    }
}
