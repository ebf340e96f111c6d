//! `generate crops`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

use crate::generate::crops::{self, Split};
use crate::generate::grammar;

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
    /// Seed of the first scene; the others follow.
    #[arg(long, default_value_t = 1_000_000)]
    pub seed: u64,
    /// Edge of the crops, pixels.
    #[arg(long, value_name = "PX", default_value_t = 64, value_parser = clap::value_parser!(u32).range(8..=512))]
    pub edge: u32,
    /// Folder of object files (`NOUN.txt`) instead of the built-in ones.
    #[arg(long, value_name = "DIR")]
    pub objects: Option<PathBuf>,
}

pub(super) fn run(args: &GenerateCropsArgs, progress: &dyn Progress) -> Result<Exit> {
    let nouns = grammar::nouns(args.objects.as_deref())?;
    let seeds = args.seed..args.seed + args.n_scenes;
    let n_crops = crops::write(&args.out, args.split, &nouns, seeds, args.edge, progress)?;
    println!("{n_crops} crops of {} nouns in {}", nouns.len(), args.out.display());
    Ok(Exit::Done)
}
