//! `generate`: scenes, crops and photos with known contents.

use std::path::PathBuf;

use anyhow::Result;
use clap::{Args, Subcommand};
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

use crate::generate::crops::Split;
use crate::generate::grammar::{self, SceneKind};
use crate::generate::{self, crops, photos};

/// `generate`.
#[derive(Debug, Subcommand)]
pub enum GenerateCommand {
    /// A scene: Gaussians, photos, poses, and the labels in `gt/`.
    Scene(GenerateSceneArgs),
    /// Crops of things with their words, to train an encoder.
    Crops(GenerateCropsArgs),
    /// Photos with the id of the thing at each pixel, to train a segmenter.
    Photos(GeneratePhotosArgs),
}

/// `generate scene`.
#[derive(Debug, Args)]
pub struct GenerateSceneArgs {
    /// Output folder; created if absent.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Kind of scene; several kinds, separated by commas, are placed side by side.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "room")]
    pub kind: Vec<SceneKind>,
    /// Seed of the contents and their looks.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Number of photos.
    #[arg(long, value_name = "N", default_value_t = 36, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub n_views: u32,
    /// Folder of object files (`NOUN.txt`) instead of the built-in ones.
    #[arg(long, value_name = "DIR")]
    pub objects: Option<PathBuf>,
}

/// `generate crops`.
#[derive(Debug, Args)]
pub struct GenerateCropsArgs {
    /// Output folder; created if absent.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// For training or for testing.
    #[arg(long, value_enum, default_value = "train")]
    pub split: Split,
    /// Number of scenes to take crops from.
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub n_scenes: u64,
    /// Seed of the first scene; the next ones count up.
    #[arg(long, default_value_t = 1_000_000)]
    pub seed: u64,
    /// Edge of the crops, pixels.
    #[arg(long, value_name = "PX", default_value_t = 64, value_parser = clap::value_parser!(u32).range(8..=512))]
    pub edge: u32,
    /// Folder of object files (`NOUN.txt`) instead of the built-in ones.
    #[arg(long, value_name = "DIR")]
    pub objects: Option<PathBuf>,
}

/// `generate photos`.
#[derive(Debug, Args)]
pub struct GeneratePhotosArgs {
    /// Output folder; created if absent.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Number of scenes to photograph.
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub n_scenes: u64,
    /// Seed of the first scene; the next ones count up.
    #[arg(long, default_value_t = 2_000_000)]
    pub seed: u64,
    /// Folder of object files (`NOUN.txt`) instead of the built-in ones.
    #[arg(long, value_name = "DIR")]
    pub objects: Option<PathBuf>,
}

pub(super) fn run(command: &GenerateCommand, progress: &dyn Progress) -> Result<Exit> {
    match command {
        GenerateCommand::Scene(args) => {
            let nouns = grammar::nouns(args.objects.as_deref())?;
            let mut scene = generate::Scene::new(&args.kind, args.seed, args.n_views, &nouns);
            let written = scene.write(&args.out, progress)?;
            println!(
                "{} Gaussians, {} things, {} photos in {}",
                scene.gaussians.len(),
                scene.objects.iter().filter(|object| !object.background).count(),
                scene.views.len(),
                args.out.display()
            );
            println!(
                "next: slag-encoder encode --scene {} --views {} --metric --store STORE",
                written.scene.display(),
                written.views.display()
            );
        }
        GenerateCommand::Crops(args) => {
            let nouns = grammar::nouns(args.objects.as_deref())?;
            let seeds = args.seed..args.seed + args.n_scenes;
            let n_crops = crops::write(&args.out, args.split, &nouns, seeds, args.edge, progress)?;
            println!("{n_crops} crops of {} nouns in {}", nouns.len(), args.out.display());
        }
        GenerateCommand::Photos(args) => {
            let nouns = grammar::nouns(args.objects.as_deref())?;
            let seeds = args.seed..args.seed + args.n_scenes;
            let n_photos = photos::write(&args.out, &nouns, seeds, progress)?;
            println!("{n_photos} photos in {}", args.out.display());
        }
    }
    Ok(Exit::Done)
}
