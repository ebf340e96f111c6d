//! `generate`: scenes, crops and photos with known contents.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::{Args, Subcommand};
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

use crate::generate::compose::Walk;
use crate::generate::copies;
use crate::generate::crops::{self, Split};
use crate::generate::grammar::{NOUNS, SceneKind};
use crate::generate::{Scene, photos};

#[derive(Debug, Subcommand)]
pub(super) enum GenerateCommand {
    /// A scene: Gaussians, photos, poses, and the labels in `gt/`.
    Scene(SceneArgs),
    /// A large scene: copies of a labelled one on a grid, with photos, masks and poses.
    Copies(CopiesArgs),
    /// Labelled crops of things, to train an encoder.
    Crops(CropsArgs),
    /// Photos with the thing's id at each pixel, to train a segmenter.
    Photos(PhotosArgs),
}

#[derive(Debug, Args)]
pub(super) struct SceneArgs {
    /// Output folder; created if absent.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Kind of scene; several kinds, separated by commas, are placed side by side.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "room")]
    kind: Vec<SceneKind>,
    /// Seed of the contents and their looks.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Number of photos.
    #[arg(long, value_name = "N", default_value_t = 36, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    n_views: u32,
    /// Where the photos are taken.
    #[arg(long, value_enum, default_value = "oval")]
    walk: Walk,
}

#[derive(Debug, Args)]
pub(super) struct CopiesArgs {
    /// Folder with a labelled scene: scene.ply or point_cloud.ply, transforms.json, photos, gt/masks.
    #[arg(long, value_name = "DIR")]
    scene: PathBuf,
    /// Output folder; created if absent.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Number of copies.
    #[arg(long, visible_alias = "n", value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    n_copies: u32,
    /// Number of photos, spread over the copies.
    #[arg(long, visible_alias = "views", value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    n_views: u32,
}

#[derive(Debug, Args)]
pub(super) struct CropsArgs {
    /// Output folder; created if absent.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// For training or for testing.
    #[arg(long, value_enum, default_value = "train")]
    split: Split,
    /// Number of scenes to take crops from.
    #[arg(long, value_name = "N", default_value_t = 100)]
    n_scenes: u64,
    /// Seed of the first scene; the others follow.
    #[arg(long, default_value_t = 1_000_000)]
    seed: u64,
    /// Edge of the crops, pixels.
    #[arg(long, value_name = "PX", default_value_t = 64, value_parser = clap::value_parser!(u32).range(8..=512))]
    edge: u32,
}

#[derive(Debug, Args)]
pub(super) struct PhotosArgs {
    /// Output folder; created if absent.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Number of scenes to photograph.
    #[arg(long, value_name = "N", default_value_t = 100)]
    n_scenes: u64,
    /// Seed of the first scene; the others follow.
    #[arg(long, default_value_t = 2_000_000)]
    seed: u64,
    /// Photos of drones, 8 to 40 m up.
    #[arg(long)]
    aerial: bool,
}

pub(super) fn run(command: &GenerateCommand, progress: &dyn Progress) -> Result<Exit> {
    match command {
        GenerateCommand::Scene(args) => scene(args, progress)?,
        GenerateCommand::Copies(args) => {
            let written = copies::write(&args.scene, &args.out, args.n_copies, args.n_views, progress)?;
            let (n, dir) = (written.n_gaussians, args.out.display());
            println!("{n} Gaussians, {} photos in {dir}; copies {:.1} apart", args.n_views, written.spacing);
            let masks =
                written.masks.map(|masks| format!("--masks {} ", masks.display())).unwrap_or_default();
            next(&written.scene, &written.views, &masks);
        }
        GenerateCommand::Crops(args) => {
            let seeds = args.seed..args.seed + args.n_scenes;
            let n = crops::write(&args.out, args.split, seeds, args.edge, progress)?;
            println!("{n} crops of {} nouns in {}", NOUNS.len(), args.out.display());
        }
        GenerateCommand::Photos(args) => {
            let seeds = args.seed..args.seed + args.n_scenes;
            let n = photos::write(&args.out, seeds, args.aerial, progress)?;
            println!("{n} photos in {}", args.out.display());
        }
    }
    Ok(Exit::Done)
}

fn scene(args: &SceneArgs, progress: &dyn Progress) -> Result<()> {
    let mut scene = Scene::new(&args.kind, args.seed, args.n_views);
    scene.photograph(args.walk, args.n_views);
    let written = scene.write(&args.out, progress)?;
    let n_things = scene.objects.iter().filter(|object| !object.background).count();
    let (n_gaussians, n_photos) = (scene.gaussians.len(), scene.views.len());
    println!("{n_gaussians} Gaussians, {n_things} things, {n_photos} photos in {}", args.out.display());
    next(&written.scene, &written.views, "--metric ");
    Ok(())
}

fn next(scene: &Path, views: &Path, flags: &str) {
    let (scene, views) = (scene.display(), views.display());
    println!("next: slag-encoder encode --scene {scene} --views {views} {flags}--store STORE");
}
