//! `eval encoder`, `eval lerf` and `eval scannet`.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_common::shard::Profile;
use slag_common::{poses, splat};

use crate::eval::lerf::{self, LerfLabels};
use crate::eval::scannet::{self, Matching, Scan, ScannetReport};
use crate::eval::{EvalSettings, encoder};
use crate::generate::grammar;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, open_models, print, text_encoder_of};
use slag_encoder::progress::Progress;
use slag_encoder::raster::CpuRasterizer;
use slag_encoder::store::StoreReader;

/// `eval encoder`.
#[derive(Debug, Args)]
pub struct EvalEncoderArgs {
    /// The encoder.
    #[command(flatten)]
    models: ModelArgs,
    /// Scenes to take crops from.
    #[arg(long, value_name = "N", default_value_t = 300)]
    n_scenes: u64,
    /// Seed of the first scene; the next ones count up. The embedded encoders learnt from 1000000 to 1012799.
    #[arg(long, default_value_t = 9_000_000)]
    seed: u64,
    /// Picture of what is taken for what, to write.
    #[arg(long, value_name = "PNG")]
    confusion: Option<PathBuf>,
}

/// `eval lerf`.
#[derive(Debug, Args)]
pub struct EvalLerfArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    store: PathBuf,
    /// The splat that was encoded.
    #[arg(long, value_name = "FILE")]
    scene: PathBuf,
    /// Poses of the labelled frames: a COLMAP model's folder or a nerfstudio transforms.json.
    #[arg(long, value_name = "PATH")]
    views: PathBuf,
    /// Labels of the scene: the folder of frame_*.json, lerf_ovs/label/NAME.
    #[arg(long, value_name = "DIR")]
    labels: PathBuf,
    /// Models; the same that the store was encoded with.
    #[command(flatten)]
    models: ModelArgs,
    /// Categories to ask for [default: all].
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    words: Vec<String>,
    /// Score as a robot with shards of this profile does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    profile: Option<Profile>,
    /// Score from which a Gaussian is selected [default: the store's].
    #[arg(long, value_name = "COSINE", allow_negative_numbers = true)]
    threshold: Option<f32>,
}

/// `eval scannet`.
#[derive(Debug, Args)]
pub struct EvalScannetArgs {
    /// Store; once for each scan.
    #[arg(long, value_name = "DIR", required = true)]
    store: Vec<PathBuf>,
    /// The splat that was encoded, in the mesh's frame; once for each scan.
    #[arg(long, value_name = "FILE", required = true)]
    scene: Vec<PathBuf>,
    /// Scan: scans/sceneXXXX_YY; may be given again.
    #[arg(long, value_name = "DIR", required = true)]
    scan: Vec<PathBuf>,
    /// scannetv2-labels.combined.tsv, for scans without a labelled mesh.
    #[arg(long, value_name = "FILE")]
    categories: Option<PathBuf>,
    /// The Gaussians were fixed to the vertices in training (OpenGaussian): compares them one by one.
    #[arg(long)]
    by_index: bool,
    /// Models; the same that the stores were encoded with.
    #[command(flatten)]
    models: ModelArgs,
    /// Score as a robot with shards of this profile does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    profile: Option<Profile>,
}

pub(super) fn run_encoder(args: &EvalEncoderArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let (models, session) = open_models(&args.models)?;
    let nouns = grammar::nouns(None)?;
    let seeds = args.seed..args.seed + args.n_scenes;
    let report = encoder::evaluate(&models, &session, &nouns, seeds, args.confusion.as_deref(), progress)?;
    print(json, &report, &report)?;
    Ok(Exit::Done)
}

pub(super) fn run_lerf(args: &EvalLerfArgs, json: bool) -> Result<Exit> {
    let reader = StoreReader::open(&args.store)?;
    let mut encoder = text_encoder_of(&reader, &args.models)?;
    let scene = splat::read(&args.scene, &splat::ReadOptions { with_sh_rest: false })?;
    let labels = LerfLabels::read(&args.labels, &poses::read(&args.views, None)?.views)?;
    let settings = EvalSettings {
        words: args.words.clone(),
        profile: args.profile,
        threshold: args.threshold,
        ..EvalSettings::default()
    };
    let report = lerf::lerf(&reader, &labels, &scene, &mut *encoder, &CpuRasterizer, &settings)?;
    print(json, &report, &report)?;
    let is_whole = report.unknown_words.is_empty() && report.frames_without_view.is_empty();
    Ok(if is_whole { Exit::Done } else { Exit::Partly })
}

pub(super) fn run_scannet(args: &EvalScannetArgs, json: bool) -> Result<Exit> {
    let (n_scans, n_stores, n_scenes) = (args.scan.len(), args.store.len(), args.scene.len());
    if n_stores != n_scans || n_scenes != n_scans {
        return Err(anyhow!(
            "{n_scans} scans, {n_stores} stores and {n_scenes} splats; give --scan, --store and --scene once each \
             for every scan, in one order"
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
    let is_whole = |s: &scannet::ScanReport| s.unknown_words.is_empty() && s.unknown_labels.is_empty();
    Ok(if report.scenes.iter().all(is_whole) { Exit::Done } else { Exit::Partly })
}
