//! A folder with a labelled scene, to be encoded and judged.

use std::path::{Path, PathBuf};

use slag_common::Gaussians;
use slag_common::splat::{self, SplatError};
use slag_encoder::encode::EncodeError;
use slag_encoder::store::StoreError;
use slag_models::ModelError;

use super::error::EvalError;
use super::truth::TruthError;

/// Error of a comparison on labelled scenes.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// A folder is not a labelled scene.
    #[error(
        "{}: no {missing}; expected a labelled scene: scene.ply or point_cloud.ply, transforms.json, gt/masks, \
         as `generate scene` writes it", dir.display()
    )]
    NoScene {
        /// The folder.
        dir: PathBuf,
        /// What is missing.
        missing: &'static str,
    },
    /// A scene cannot be encoded.
    #[error(transparent)]
    Encode(#[from] Box<EncodeError>),
    /// A store cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A splat cannot be read.
    #[error(transparent)]
    Splat(#[from] SplatError),
    /// The labels cannot be used.
    #[error(transparent)]
    Truth(#[from] TruthError),
    /// The text model cannot be opened.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A store cannot be evaluated.
    #[error(transparent)]
    Eval(#[from] EvalError),
    /// A folder cannot be created.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// A labelled scene: its files, and its splat.
pub(super) struct LabelledScene {
    /// The folder's name.
    pub(super) name: String,
    pub(super) splat: PathBuf,
    pub(super) views: PathBuf,
    /// The photos' folder, where there is one of that name.
    pub(super) images: Option<PathBuf>,
    /// The true masks.
    pub(super) masks: PathBuf,
    pub(super) gaussians: Gaussians,
}

impl LabelledScene {
    /// Finds the files and reads the splat.
    ///
    /// # Errors
    /// [`CompareError::NoScene`], [`CompareError::Splat`].
    pub(super) fn open(dir: &Path) -> Result<Self, CompareError> {
        let find = |names: &[&'static str]| -> Result<PathBuf, CompareError> {
            let found = names.iter().map(|name| dir.join(name)).find(|path| path.exists());
            found.ok_or(CompareError::NoScene { dir: dir.to_owned(), missing: names[0] })
        };
        let splat = find(&["scene.ply", "point_cloud.ply"])?;
        let gaussians = splat::read(&splat, &splat::ReadOptions { with_sh_rest: false })?;
        let images = dir.join("images");
        Ok(Self {
            name: dir.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            splat,
            views: find(&["transforms.json"])?,
            images: images.is_dir().then_some(images),
            masks: find(&["gt/masks"])?,
            gaussians,
        })
    }
}
