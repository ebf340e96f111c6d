//! `bench tradeoff`.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;

use super::sibling::sibling;
use crate::bench::tradeoff::{self, Equipment, Grid, LabelledScene, Programs, TradeoffSettings};
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, open_models, print};
use slag_encoder::progress::Progress;
use slag_encoder::raster::gpu::adapters;

/// `bench tradeoff`.
#[derive(Debug, Args)]
pub struct TradeoffArgs {
    /// Labelled scene: a folder that `generate scene` wrote; may be repeated.
    #[arg(long, visible_alias = "scene", value_name = "DIR", required = true, num_args = 1..)]
    truth: Vec<PathBuf>,
    /// Folder for figures and plots; points measured there before are not measured again.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The same as `--grid quick`.
    #[arg(long, conflicts_with = "grid")]
    quick: bool,
    /// What to measure: `full`; `quick`, a small grid with the scenes' own masks (ten minutes on two cores); `paper`,
    /// the paper's four configurations of SAM's grid and image step (needs --segmenter); or a file: JSON,
    /// {"points": [..]} of axis, name, and flags (views, lift, eval, profile).
    #[arg(long, value_name = "full|quick|paper|FILE", default_value = "full")]
    grid: PathBuf,
    /// Model directory of Segment Anything; without it the points that need one are left out.
    #[arg(long, value_name = "DIR")]
    segmenter: Option<PathBuf>,
    /// Models.
    #[command(flatten)]
    models: ModelArgs,
}

pub(super) fn run(args: &TradeoffArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let grid = match args.grid.to_str() {
        _ if args.quick => Grid::quick()?,
        Some("quick") => Grid::quick()?,
        Some("paper") => Grid::paper()?,
        Some("full") => Grid::full()?,
        _ => Grid::read(&args.grid)?,
    };
    // Opened first: a model that cannot be opened fails before hours of work.
    let (models, session) = open_models(&args.models)?;
    let lab = std::env::current_exe().context("cannot find the path of this program")?;
    let (encoder, edge) = (sibling("slag-encoder")?, sibling("slag-edge")?);
    if !edge.is_file() {
        tracing::warn!(
            "{} does not exist, so queries are not timed; build it beside this program",
            edge.display()
        );
    }
    let mut flags = Vec::new();
    let mut flag = |name: &str, value: String| flags.extend([name.to_owned(), value]);
    if let Some(path) = &args.models.models {
        flag("--models", path.display().to_string());
    }
    if let Some(path) = &args.models.how.runtime {
        flag("--runtime", path.display().to_string());
    }
    let providers = args.models.how.provider.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
    flag("--provider", providers);
    if let Some(n) = args.models.how.model_threads {
        flag("--model-threads", n.to_string());
    }
    let programs = Programs {
        encoder,
        lab,
        edge: Some(edge).filter(|path| path.is_file()),
        models: flags,
        equipment: Equipment { segmenter: args.segmenter.clone(), n_gpus: n_gpus() },
        made_by: format!("{} {}, {:?}", env!("CARGO_PKG_VERSION"), models.encoder_id(), session.providers),
    };
    let scenes = args.truth.iter().map(|dir| LabelledScene::find(dir)).collect::<Result<_, _>>()?;
    let settings = TradeoffSettings { scenes, grid, out: args.out.clone() };
    let report = tradeoff::run(&settings, &programs, progress)?;
    print(json, &report, &report)?;
    Ok(if report.left_out.is_empty() { Exit::Done } else { Exit::Partly })
}

/// Returns the number of GPUs that `--device` numbers.
fn n_gpus() -> usize {
    let reports: Vec<_> = adapters().into_iter().map(|adapter| adapter.report).collect();
    // A GPU appears once per graphics interface.
    let first = reports.first().map(|report| report.backend.clone());
    reports.iter().filter(|r| Some(&r.backend) == first.as_ref() && !r.is_software()).count()
}
