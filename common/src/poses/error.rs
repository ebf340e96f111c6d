//! Errors of the pose readers.

use std::fmt::{self, Debug, Display};
use std::io;
use std::path::Path;

use crate::files::WrongContent;

/// Why poses are not read: the file, the place of the fault, what is wrong, and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct PoseError(String);

impl From<io::Error> for PoseError {
    fn from(cause: io::Error) -> Self {
        Self(format!("{cause}; check that the file exists and is readable"))
    }
}

impl PoseError {
    pub(super) fn of(path: &Path, fault: impl Display) -> Self {
        Self(format!("{}: {fault}", path.display()))
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Place {
    File,
    /// A line, counted from 1.
    Line(u64),
    Byte(u64),
    /// An element of the array `frames`, counted from 0.
    Frame(usize),
}

impl Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File => write!(f, "file"),
            Self::Line(line) => write!(f, "line {line}"),
            Self::Byte(offset) => write!(f, "byte {offset}"),
            Self::Frame(index) => write!(f, "frames[{index}]"),
        }
    }
}

/// What is wrong at a place of a file, and what to do.
#[derive(Clone, Debug)]
pub(super) struct PoseProblem {
    pub(super) fault: String,
    pub(super) advice: &'static str,
}

impl PoseProblem {
    pub(super) fn new(fault: impl Into<String>, advice: &'static str) -> Self {
        Self { fault: fault.into(), advice }
    }

    pub(super) fn expected(expected: &str, found: impl Debug) -> Self {
        Self::new(format!("expected {expected}, found {found:?}"), "export the poses again")
    }

    pub(super) fn truncated(expected: &str) -> Self {
        Self::new(format!("the file ends before {expected}"), "copy or export it again")
    }

    pub(super) fn too_large(bytes: u64, most: u64, expected: &str) -> Self {
        let fault = format!("the file has {bytes} bytes, at most {most} were expected of {expected}");
        Self::new(fault, "check that it is the right file")
    }

    pub(super) fn unsafe_name(image: &str) -> Self {
        let fault = format!("image name {image:?} is not a relative path inside the image folder");
        Self::new(fault, "correct it")
    }

    pub(super) fn at(self, path: &Path, place: Place) -> PoseError {
        let Self { fault, advice } = self;
        PoseError::of(path, format_args!("{place}: {fault}; {advice}"))
    }
}

impl From<WrongContent> for PoseProblem {
    fn from(found: WrongContent) -> Self {
        Self::new(found.what, found.advice)
    }
}
