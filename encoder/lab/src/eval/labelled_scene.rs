//! A folder with a labelled scene, to be encoded and judged.

use std::io;
use std::path::{Path, PathBuf};

use slag_common::Gaussians;
use slag_common::splat::{self, SplatError};
use slag_encoder::encode::{EncodeError, EncodeSettings, InputSettings, Masks};
use slag_encoder::store::StoreError;
use slag_models::ModelError;

use super::error::EvalError;
use super::truth::{Truth, TruthError};

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
    pub(super) gaussians: Gaussians,
    /// The labels, for an evaluation in 3D alone.
    pub(super) truth: Truth,
    inputs: InputSettings,
    masks: PathBuf,
}

impl LabelledScene {
    /// Finds the files, reads as `base` says where they leave a choice, and reads the splat and the labels.
    ///
    /// # Errors
    /// [`CompareError::NoScene`], [`CompareError::Splat`], [`CompareError::Truth`].
    pub(super) fn open(dir: &Path, base: &InputSettings) -> Result<Self, CompareError> {
        let find = |names: &[&'static str]| -> Result<PathBuf, CompareError> {
            let found = names.iter().map(|name| dir.join(name)).find(|path| path.exists());
            found.ok_or(CompareError::NoScene { dir: dir.to_owned(), missing: names[0] })
        };
        let splat = find(&["scene.ply", "point_cloud.ply"])?;
        let gaussians = splat::read(&splat, &splat::ReadOptions { with_sh_rest: false })?;
        let images = dir.join("images");
        let inputs = InputSettings {
            added: Vec::new(),
            dropped: Vec::new(),
            scene: splat,
            views: find(&["transforms.json"])?,
            images: images.is_dir().then_some(images),
            ..base.clone()
        };
        let masks = find(&["gt/masks"])?;
        let mut truth = Truth::read(dir, gaussians.len())?;
        // Rendering every word on every view would take most of the time.
        truth.views.clear();
        let name = dir.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self { name, gaussians, truth, inputs, masks })
    }

    /// Returns `base` with this scene's files, with its views kept in `store`, which is created.
    ///
    /// # Errors
    /// If the folder cannot be created.
    pub(super) fn encode_settings(
        &self,
        base: &EncodeSettings,
        store: PathBuf,
    ) -> io::Result<EncodeSettings> {
        fs_err::create_dir_all(&store)?;
        let mut settings = base.clone();
        settings.inputs = self.inputs.clone();
        settings.output.store = store;
        settings.run.keep_views = true;
        Ok(settings)
    }

    /// The true masks.
    pub(super) fn true_masks(&self) -> Masks {
        Masks::Given { dir: self.masks.clone(), ignore_ids: Vec::new() }
    }
}
