//! `eval defaults`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use crate::eval::defaults::{self, DefaultsRow, DefaultsSettings};
use slag_common::shard::Profile;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, cancel_flag, open_models, print};
use slag_encoder::encode::EncodeSettings;
use slag_encoder::progress::Progress;
use slag_encoder::raster::devices::{DeviceChoice, Devices};
use slag_encoder::raster::gpu::GpuOptions;

/// Rows of a scene: given and automatic masks; the plain average, and the default by Gaussian and by object.
const ROWS_PER_SCENE: usize = 6;

/// `eval defaults`.
#[derive(Debug, Args)]
pub struct EvalDefaultsArgs {
    /// Labelled scenes: a splat, transforms.json, photos and gt/, as `generate scene` writes them.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    scene: Vec<PathBuf>,
    /// Models.
    #[command(flatten)]
    models: ModelArgs,
    /// Device that rasterises: auto (GPUs, else the CPU), gpu, cpu, or an adapter's number.
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceChoice,
    /// Folder for the stores; a later run reuses the views there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub(super) fn run(args: &EvalDefaultsArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let (models, session) = open_models(&args.models)?;
    let devices = Devices::open(args.device, GpuOptions::default())?;
    let mut encode = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
    encode.output.scene_name = "defaults".into();
    encode.run.strict = true;
    encode.run.restart = true;
    encode.cells.shards.profiles = vec![Profile::Exact];
    let settings = DefaultsSettings { scenes: args.scene.clone(), out: args.out.clone(), encode };
    progress.begin("defaults", "row", (args.scene.len() * ROWS_PER_SCENE) as u64, 0);
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
