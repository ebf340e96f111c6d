//! `bench tradeoff`: cost and accuracy of each choice of settings, on labelled scenes.
//!
//! For each point of a [`grid`], the programs encode and evaluate the scene as a user runs them, each in its own
//! process, so that threads and memory are those of the flags. A point leaves one JSON file; points with a file are
//! not measured again. Points with the same contributions share a store: the first carries the seconds of the views.

mod grid;
mod measure;
mod report;
#[cfg(test)]
mod tests;

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use slag_encoder::cli::common::{ModelArgs, open_models};
use slag_encoder::progress::Progress;

use crate::programs::sibling;
use crate::scenes::SceneFiles;
use grid::Grid;
use measure::{Programs, measure};
pub(crate) use report::TradeoffReport;

#[derive(Debug, Args)]
pub(crate) struct TradeoffArgs {
    /// Labelled scene: a folder that `generate scene` wrote; may be repeated.
    #[arg(long, visible_alias = "truth", value_name = "DIR", required = true, num_args = 1..)]
    scene: Vec<PathBuf>,
    /// Folder for figures; points measured there before are not measured again.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// What to measure: `full`; `quick`, a small grid with the scenes' own masks (ten minutes on two cores);
    /// `paper`, the paper's four configurations of SAM's grid and image step (needs --segmenter); or a file: JSON,
    /// {"points": [..]} of axis, name, and flags (views, lift, profile).
    #[arg(long, value_name = "full|quick|paper|FILE", default_value = "full")]
    grid: PathBuf,
    /// Model directory of Segment Anything; without it the points that need one are left out.
    #[arg(long, value_name = "DIR")]
    segmenter: Option<PathBuf>,
    #[command(flatten)]
    models: ModelArgs,
}

pub(crate) fn run(args: &TradeoffArgs, progress: &dyn Progress) -> Result<TradeoffReport> {
    let grid = Grid::find(&args.grid)?;
    // Opened first: a model that cannot be opened fails before hours of work.
    let (models, session) = open_models(&args.models)?;
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
    let lab = std::env::current_exe().context("cannot find the path of this program")?;
    let programs = Programs {
        encoder: sibling("slag-encoder")?,
        lab,
        models: flags,
        segmenter: args.segmenter.clone(),
        made_by: format!("{} {}, {:?}", env!("CARGO_PKG_VERSION"), models.encoder_id(), session.providers),
    };
    measure(&SceneFiles::find_all(&args.scene)?, &grid, &programs, &args.out, progress)
}
