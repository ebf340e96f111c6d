//! `eval labelled`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_common::shard::Profile;
use slag_common::splat;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, text_encoder_of};
use slag_encoder::raster::CpuRasterizer;
use slag_encoder::store::StoreReader;

use super::output::Output;
use crate::eval::{self, EvalKind, EvalSettings, Filter, Truth};

/// `eval labelled`.
#[derive(Debug, Args)]
pub struct EvalLabelledArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// The splat that was encoded.
    #[arg(long, value_name = "FILE")]
    pub scene: PathBuf,
    /// Folder of the labels: gt/instances.json, gt/gaussian_instance.npy; test/ and gt/test_masks/ where present.
    #[arg(long, value_name = "DIR")]
    pub truth: PathBuf,
    /// The models that the store was encoded with.
    #[command(flatten)]
    pub models: ModelArgs,
    /// Categories to query [default: all].
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    pub words: Vec<String>,
    /// Scores this profile's shards, as a robot does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    pub profile: Option<Profile>,
    /// Scores coarse and fine masks separately and takes the best instead of their mean.
    #[arg(long, conflicts_with = "profile")]
    pub by_mask_level: bool,
    /// Lowest score of a match [default: the store's].
    #[arg(long, value_name = "COSINE", allow_negative_numbers = true)]
    pub threshold: Option<f32>,
    /// Gives the Gaussians of a superpoint one answer, as the paper does.
    #[arg(long, value_enum)]
    pub superpoints: Option<Filter>,
    /// What is scored [default: objects, where the scene has them].
    #[arg(long, value_enum)]
    pub kind: Option<EvalKind>,
}

pub(super) fn run(args: &EvalLabelledArgs, output: &Output<'_>) -> Result<Exit> {
    let reader = StoreReader::open(&args.store)?;
    let mut encoder = text_encoder_of(&reader, &args.models)?;
    let scene = splat::read(&args.scene, &splat::ReadOptions { with_sh_rest: false })?;
    let truth = Truth::read(&args.truth, scene.len())?;
    let settings = EvalSettings {
        words: args.words.clone(),
        profile: args.profile,
        threshold: args.threshold,
        filter: args.superpoints,
        kind: args.kind,
        by_mask_level: args.by_mask_level,
    };
    let report = eval::labelled(&reader, &truth, &scene, &mut *encoder, &CpuRasterizer, &settings)?;
    output.print(&report)?;
    Ok(Exit::Done)
}
