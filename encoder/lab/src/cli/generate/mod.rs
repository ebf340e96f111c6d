//! `generate`: scenes, crops and photos with known contents.

mod copies;
mod crops;
mod photos;
mod scene;

use anyhow::Result;
use clap::Subcommand;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

/// `generate`.
#[derive(Debug, Subcommand)]
pub enum GenerateCommand {
    /// A scene: Gaussians, photos, poses, and the labels in `gt/`.
    Scene(scene::GenerateSceneArgs),
    /// A large scene: copies of a labelled one on a grid, with photos, masks and poses.
    Copies(copies::GenerateCopiesArgs),
    /// Labelled crops of things, to train an encoder.
    Crops(crops::GenerateCropsArgs),
    /// Photos with the thing's id at each pixel, to train a segmenter.
    Photos(photos::GeneratePhotosArgs),
}

pub(super) fn run(command: &GenerateCommand, progress: &dyn Progress) -> Result<Exit> {
    match command {
        GenerateCommand::Scene(args) => scene::run(args, progress),
        GenerateCommand::Copies(args) => copies::run(args, progress),
        GenerateCommand::Crops(args) => crops::run(args, progress),
        GenerateCommand::Photos(args) => photos::run(args, progress),
    }
}
