//! `eval scannet`.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_common::shard::Profile;
use slag_common::splat;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, print, text_encoder_of};
use slag_encoder::store::StoreReader;

use crate::eval::EvalSettings;
use crate::eval::scan::Scan;
use crate::eval::scannet::{self, Matching, ScannetReport};

/// `eval scannet`.
#[derive(Debug, Args)]
pub struct EvalScannetArgs {
    /// Store; once per scan.
    #[arg(long, value_name = "DIR", required = true)]
    store: Vec<PathBuf>,
    /// The splat that was encoded, in the mesh's frame; once per scan.
    #[arg(long, value_name = "FILE", required = true)]
    scene: Vec<PathBuf>,
    /// Scan: scans/sceneXXXX_YY; may be repeated.
    #[arg(long, value_name = "DIR", required = true)]
    scan: Vec<PathBuf>,
    /// scannetv2-labels.combined.tsv, for scans without a labelled mesh.
    #[arg(long, value_name = "FILE")]
    categories: Option<PathBuf>,
    /// Compares Gaussians and vertices one by one, for splats trained with Gaussians fixed to the vertices (OpenGaussian).
    #[arg(long)]
    by_index: bool,
    /// The models that the stores were encoded with.
    #[command(flatten)]
    models: ModelArgs,
    /// Scores this profile's shards, as a robot does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    profile: Option<Profile>,
}

pub(super) fn run(args: &EvalScannetArgs, json: bool) -> Result<Exit> {
    let (n_scans, n_stores, n_scenes) = (args.scan.len(), args.store.len(), args.scene.len());
    if n_stores != n_scans || n_scenes != n_scans {
        return Err(anyhow!(
            "{n_scans} scans, {n_stores} stores and {n_scenes} splats; give --scan, --store and --scene once per scan, \
             in the same order"
        ));
    }
    let matching = if args.by_index { Matching::Index } else { Matching::Nearest };
    let settings = EvalSettings { profile: args.profile, ..EvalSettings::default() };
    let mut scenes = Vec::new();
    for ((scan, store), scene) in args.scan.iter().zip(&args.store).zip(&args.scene) {
        let reader = StoreReader::open(store)?;
        let mut encoder = text_encoder_of(&reader, &args.models)?;
        let scene = splat::read(scene, &splat::ReadOptions { with_sh_rest: false })?;
        let scan = Scan::read(scan, args.categories.as_deref())?;
        scenes.push(scannet::scannet(&reader, &scan, &scene, &mut *encoder, matching, &settings)?);
    }
    let report = ScannetReport::new(scenes);
    print(json, &report, &report)?;
    let is_complete = |s: &scannet::ScanReport| s.unknown_words.is_empty() && s.unknown_labels.is_empty();
    Ok(if report.scenes.iter().all(is_complete) { Exit::Done } else { Exit::Partly })
}
