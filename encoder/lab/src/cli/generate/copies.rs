//! `generate copies`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

use crate::generate::copies::{self, CopiesSettings};

/// `generate copies`.
#[derive(Debug, Args)]
pub struct GenerateCopiesArgs {
    /// Folder with a labelled scene: scene.ply or point_cloud.ply, transforms.json, photos, gt/masks.
    #[arg(long, value_name = "DIR")]
    pub scene: PathBuf,
    /// Output folder; created if absent.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Number of copies.
    #[arg(long, visible_alias = "n", value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub n_copies: u32,
    /// Number of photos, spread over the copies.
    #[arg(long, visible_alias = "views", value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub n_views: u32,
}

pub(super) fn run(args: &GenerateCopiesArgs, progress: &dyn Progress) -> Result<Exit> {
    let settings = CopiesSettings { n_copies: args.n_copies, n_views: args.n_views };
    let written = copies::write(&args.scene, &args.out, settings, progress)?;
    let dir = args.out.display();
    println!(
        "{} Gaussians, {} photos in {dir}; copies {:.1} apart",
        written.n_gaussians, args.n_views, written.spacing
    );
    let masks = written.masks.map(|masks| format!(" --masks {}", masks.display())).unwrap_or_default();
    let (scene, views) = (written.scene.display(), written.views.display());
    println!("next: slag-encoder encode --scene {scene} --views {views}{masks} --store STORE");
    Ok(Exit::Done)
}
