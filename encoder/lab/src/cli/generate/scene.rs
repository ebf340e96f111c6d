//! `generate scene`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

use crate::generate::Scene;
use crate::generate::compose::Walk;
use crate::generate::grammar::{self, SceneKind};

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
    /// Where the photos are taken.
    #[arg(long, value_enum, default_value = "oval")]
    pub walk: Walk,
    /// Folder of object files (`NOUN.txt`) instead of the built-in ones.
    #[arg(long, value_name = "DIR")]
    pub objects: Option<PathBuf>,
}

pub(super) fn run(args: &GenerateSceneArgs, progress: &dyn Progress) -> Result<Exit> {
    let nouns = grammar::nouns(args.objects.as_deref())?;
    let mut scene = Scene::new(&args.kind, args.seed, args.n_views, &nouns);
    scene.photograph(args.walk, args.n_views);
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
    Ok(Exit::Done)
}
