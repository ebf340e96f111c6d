//! `eval lerf`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_common::shard::Profile;
use slag_common::{poses, splat};
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, parse_frame, text_encoder_of};
use slag_encoder::ingest::{self, FrameChoice};
use slag_encoder::raster::CpuRasterizer;
use slag_encoder::store::StoreReader;

use super::output::Output;
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
    /// Says how the splat's frame follows from that of the poses, see `slag-encoder encode --help`: auto, none or a file.
    #[arg(long, value_name = "auto|none|FILE", default_value = "auto", value_parser = parse_frame)]
    splat_frame: FrameChoice,
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

pub(super) fn run(args: &EvalLerfArgs, output: &Output<'_>) -> Result<Exit> {
    let reader = StoreReader::open(&args.store)?;
    let mut encoder = text_encoder_of(&reader, &args.models)?;
    let views = poses::read(&args.views, None)?;
    let frame = ingest::find_frame(&args.scene, &args.splat_frame, views.source, views.applied)?;
    let mut scene = splat::read(&args.scene, &splat::ReadOptions { with_sh_rest: false })?;
    if let Some(frame) = frame {
        tracing::info!("{frame}; the splat is brought into the world of the poses");
        frame.to_poses(&mut scene);
    }
    let labels = LerfLabels::read(&args.labels, &views.views)?;
    let settings = EvalSettings {
        words: args.words.clone(),
        profile: args.profile,
        threshold: args.threshold,
        ..EvalSettings::default()
    };
    let report = lerf::lerf(&reader, &labels, &scene, &mut *encoder, &CpuRasterizer, &settings)?;
    output.print(&report)?;
    let is_complete = report.unknown_words.is_empty() && report.frames_without_view.is_empty();
    Ok(if is_complete { Exit::Done } else { Exit::Partly })
}
