//! `eval defaults`.

use anyhow::Result;
use clap::Args;

use super::comparison::{ComparisonArgs, encode_settings};
use crate::eval::defaults::{self, DefaultsRow, DefaultsSettings};
use slag_common::shard::Profile;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{cancel_flag, open_models, print};
use slag_encoder::progress::Progress;
use slag_encoder::raster::devices::Devices;
use slag_encoder::raster::gpu::GpuOptions;

/// Rows of a scene with given and automatic masks: the plain average by Gaussian; each other method by Gaussian and by object.
const fn rows_per_scene(n_methods: usize) -> usize {
    2 * (2 * n_methods - 1)
}

/// `eval defaults`.
#[derive(Debug, Args)]
pub struct EvalDefaultsArgs {
    /// Scenes, models and output.
    #[command(flatten)]
    on: ComparisonArgs,
    /// Adds rows of the default with this weight of the object's mean, as `encode --object`.
    #[arg(long, value_name = "TIMES")]
    object: Option<f32>,
}

pub(super) fn run(args: &EvalDefaultsArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let (models, session) = open_models(&args.on.models)?;
    let devices = Devices::open(args.on.device, GpuOptions::default())?;
    let mut encode = encode_settings("defaults");
    encode.cells.shards.profiles = vec![Profile::Exact];
    let n_rows = args.on.scene.len() * rows_per_scene(2 + usize::from(args.object.is_some()));
    let (scenes, out) = (args.on.scene.clone(), args.on.out.clone());
    let settings = DefaultsSettings { scenes, out, object: args.object, encode };
    progress.begin("defaults", "row", n_rows as u64, 0);
    let mut on_row = |row: &DefaultsRow| {
        tracing::info!("{} {:?}: AP {:.4?}", row.scene, row.masks, row.average_precision);
        progress.advance(1);
    };
    let cancel = cancel_flag()?;
    let report = defaults::run(&settings, (&models, &session), &devices, &mut on_row, cancel.as_ref())?;
    progress.end();
    print(json, &report, &report)?;
    Ok(Exit::Done)
}
