//! The description of a model directory: encoders or a segmenter.

use std::path::Path;

use crate::description::{Description, DescriptionError, FILE_NAME, FileRef, read_toml};
use crate::sam::SamDescription;

pub(crate) enum Described {
    Encoders(Box<Description>),
    Segmenter(Box<SamDescription>),
}

impl Described {
    /// Reads `folder`'s description; a segmenter's has `[segment]`.
    pub(crate) fn read(folder: &Path) -> Result<Self, DescriptionError> {
        let path = folder.join(FILE_NAME);
        Ok(match read_toml::<toml::Table>(&path)?.contains_key("segment") {
            true => Self::Segmenter(Box::new(SamDescription::read(&path)?)),
            false => Self::Encoders(Box::new(Description::read(&path)?)),
        })
    }

    pub(crate) fn files_root(&self) -> &Path {
        match self {
            Self::Encoders(encoders) => &encoders.files_root,
            Self::Segmenter(segmenter) => &segmenter.files_root,
        }
    }

    pub(crate) fn files(&self) -> Vec<(&'static str, &FileRef)> {
        match self {
            Self::Encoders(encoders) => encoders.files(),
            Self::Segmenter(segmenter) => segmenter.files(),
        }
    }
}
