//! `eval defaults`.

use anyhow::Result;
use clap::Args;

use super::comparison::{ComparisonArgs, encode_settings};
use super::output::Output;
use crate::eval::defaults::{self, DefaultsRow, DefaultsSettings};
use slag_common::shard::Profile;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{cancel_flag, open_models};
use slag_encoder::progress::Progress;
use slag_encoder::raster::devices::Devices;
use slag_encoder::raster::gpu::GpuOptions;

/// Rows of a scene: given and automatic masks; the plain average, and the default by Gaussian and by object.
const ROWS_PER_SCENE: usize = 6;

/// `eval defaults`.
#[derive(Debug, Args)]
pub struct EvalDefaultsArgs {
    /// Scenes, models and output.
    #[command(flatten)]
    on: ComparisonArgs,
}

pub(super) fn run(args: &EvalDefaultsArgs, progress: &dyn Progress, output: &Output<'_>) -> Result<Exit> {
    let (models, session) = open_models(&args.on.models)?;
    let devices = Devices::open(&args.on.device, GpuOptions::default())?;
    let mut encode = encode_settings("defaults");
    encode.cells.shards.profiles = vec![Profile::Exact];
    let settings = DefaultsSettings { scenes: args.on.scene.clone(), out: args.on.out.clone(), encode };
    progress.begin("defaults", "row", (args.on.scene.len() * ROWS_PER_SCENE) as u64, 0);
    let mut on_row = |row: &DefaultsRow| {
        tracing::info!("{} {:?}: AP {:.4?}", row.scene, row.masks, row.average_precision);
        progress.advance(1);
    };
    let cancel = cancel_flag()?;
    let report = defaults::run(&settings, (&models, &session), &devices, &mut on_row, cancel.as_ref())?;
    progress.end();
    output.print(&report)?;
    Ok(Exit::Done)
}
