//! `eval noise`.

use anyhow::{Result, anyhow};
use clap::Args;

use super::comparison::{ComparisonArgs, encode_settings};
use super::output::Output;
use crate::eval::noise::{self, NoiseRow, NoiseSettings};
use slag_common::shard::Profile;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{cancel_flag, open_models};
use slag_encoder::embed::Background;
use slag_encoder::encode::{ViewOrder, ViewsLimit};
use slag_encoder::lift::Aggregation;
use slag_encoder::progress::Progress;
use slag_encoder::raster::devices::Devices;
use slag_encoder::raster::gpu::GpuOptions;

/// `eval noise`.
#[derive(Debug, Args)]
pub struct EvalNoiseArgs {
    /// Scenes, models and output.
    #[command(flatten)]
    on: ComparisonArgs,
    /// Levels of noise in the true masks, 0 (none) to 3.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [0, 1, 2, 3], value_parser = clap::value_parser!(u8).range(0..=3))]
    levels: Vec<u8>,
    /// Seed of the noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Uses the masks of the built-in segmenter instead, without noise.
    #[arg(long, conflicts_with = "levels")]
    auto: bool,
    /// Aggregation methods [default: all].
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    methods: Vec<String>,
    /// Largest number of views, evenly spread.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    views_limit: Option<u32>,
    /// Fill of a crop outside its mask.
    #[arg(long, value_enum, default_value = "white")]
    background: Background,
}

pub(super) fn run(args: &EvalNoiseArgs, progress: &dyn Progress, output: &Output<'_>) -> Result<Exit> {
    let known = Aggregation::methods();
    let wanted = |name: &str| args.methods.is_empty() || args.methods.iter().any(|method| method == name);
    if let Some(unknown) = args.methods.iter().find(|name| !known.iter().any(|(known, _)| known == name)) {
        let names: Vec<&str> = known.iter().map(|(name, _)| *name).collect();
        return Err(anyhow!("unknown aggregation method {unknown:?}; expected one of: {}", names.join(", ")));
    }
    let (models, session) = open_models(&args.on.models)?;
    let devices = Devices::open(&args.on.device, GpuOptions::default())?;
    let methods: Vec<(String, Aggregation)> = known
        .into_iter()
        .filter(|(name, _)| wanted(name))
        .map(|(name, aggregation)| (name.to_owned(), aggregation))
        .collect();
    let levels = if args.auto { Vec::new() } else { args.levels.clone() };
    let n_rows = args.on.scene.len() * levels.len().max(1) * methods.len();
    let mut encode = encode_settings("noise");
    encode.run.views_limit = args.views_limit.map_or(ViewsLimit::All, |n| ViewsLimit::Count(n as usize));
    encode.run.view_order = ViewOrder::Nth;
    encode.view.background = args.background;
    encode.cells.shards.profiles = vec![Profile::Compact];
    encode.cells.objects = false;
    let settings = NoiseSettings {
        scenes: args.on.scene.clone(),
        levels,
        seed: args.seed,
        methods,
        out: args.on.out.clone(),
        encode,
    };
    progress.begin("noise", "row", n_rows as u64, 0);
    let mut on_row = |row: &NoiseRow| {
        tracing::info!("{} {:?} {}: mIoU {:.4?}", row.scene, row.level, row.method, row.miou);
        progress.advance(1);
    };
    let report = noise::run(&settings, (&models, &session), &devices, &mut on_row, cancel_flag()?.as_ref())?;
    progress.end();
    output.print(&report)?;
    Ok(Exit::Done)
}
