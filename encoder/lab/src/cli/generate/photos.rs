//! `generate photos`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

use crate::generate::grammar;
use crate::generate::photos;

/// `generate photos`.
#[derive(Debug, Args)]
pub struct GeneratePhotosArgs {
    /// Output folder; created if absent.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Number of scenes to photograph.
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub n_scenes: u64,
    /// Seed of the first scene; the others follow.
    #[arg(long, default_value_t = 2_000_000)]
    pub seed: u64,
    /// Folder of object files (`NOUN.txt`) instead of the built-in ones.
    #[arg(long, value_name = "DIR")]
    pub objects: Option<PathBuf>,
}

pub(super) fn run(args: &GeneratePhotosArgs, progress: &dyn Progress) -> Result<Exit> {
    let nouns = grammar::nouns(args.objects.as_deref())?;
    let seeds = args.seed..args.seed + args.n_scenes;
    let n_photos = photos::write(&args.out, &nouns, seeds, progress)?;
    println!("{n_photos} photos in {}", args.out.display());
    Ok(Exit::Done)
}
