//! `eval lerf`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_common::shard::Profile;
use slag_common::{poses, splat};
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, print, text_encoder_of};
use slag_encoder::raster::CpuRasterizer;
use slag_encoder::store::StoreReader;

use crate::eval::EvalSettings;
use crate::eval::lerf::{self, LerfLabels};

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
    /// The models that the store was encoded with.
    #[command(flatten)]
    models: ModelArgs,
    /// Categories to query [default: all].
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    words: Vec<String>,
    /// Scores this profile's shards, as a robot does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    profile: Option<Profile>,
    /// Lowest score of a selected Gaussian [default: the store's].
    #[arg(long, value_name = "COSINE", allow_negative_numbers = true)]
    threshold: Option<f32>,
}

pub(super) fn run(args: &EvalLerfArgs, json: bool) -> Result<Exit> {
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
    let is_complete = report.unknown_words.is_empty() && report.frames_without_view.is_empty();
    Ok(if is_complete { Exit::Done } else { Exit::Partly })
}
