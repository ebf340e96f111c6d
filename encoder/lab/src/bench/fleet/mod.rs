//! Simulates fleets of many machines on the measured times and bytes of an encode: where more machines stop paying.
//!
//! A machine is the one that was measured. A scene of N views is the measured one, over and over: as many cells and seconds
//! of the coordinator more as views. Two ways to hand out the same work are compared: views and cells to the machine that is
//! free next, costly ones first, as `worker` takes them; and batches of views of equal number, made beforehand: the paper gives
//! each GPU one subset of the images, unbalanced.
//!
//! | file | job |
//! |---|---|
//! | [`simulate`] | the time of the views and cells of a fleet |
//! | [`report`] | table and plot |

pub mod report;
pub mod simulate;
#[cfg(test)]
mod tests;

use std::path::Path;

use anyhow::{Context, Result, bail};
use serde::Deserialize;
use slag_encoder::encode::{ViewCost, view_costs};
use slag_encoder::store::Store;

pub use report::FleetReport;
pub use simulate::{Links, Work};

/// The parts of an encode's summary that are read.
#[derive(Deserialize)]
struct Summary {
    n_views: usize,
    n_cells: usize,
    phases: Vec<Phase>,
}

#[derive(Deserialize)]
struct Phase {
    phase: String,
    secs: f64,
}

/// Reads the measured work: a store that keeps the views of an encode (`--keep-views`), and what `encode --json`
/// printed of it.
///
/// # Errors
/// If the store keeps other views than the encode had, or a file cannot be read.
pub fn measured(store: &Path, summary: &Path) -> Result<Work> {
    let text = fs_err::read_to_string(summary)?;
    let summary: Summary = serde_json::from_str(&text)
        .with_context(|| format!("{}: expected the output of `encode --json`", summary.display()))?;
    let mut views = view_costs(&Store::create_or_open(store)?)?;
    if views.len() != summary.n_views || views.is_empty() {
        bail!(
            "{} keeps {} views, the summary has {}: encode once more into an empty store, with --keep-views",
            store.display(),
            views.len(),
            summary.n_views
        );
    }
    let secs = |of: &dyn Fn(&str) -> bool| -> f64 {
        summary.phases.iter().filter(|phase| of(&phase.phase)).map(|phase| phase.secs).sum()
    };
    // Views overlap: together they took the phase's time.
    let sum: f64 = views.iter().map(|view| view.secs).sum();
    let scale = secs(&|phase| phase == "views") / sum.max(f64::MIN_POSITIVE);
    views.iter_mut().for_each(|ViewCost { secs, .. }| *secs *= scale);
    let cell = secs(&|phase| phase == "cells") / summary.n_cells.max(1) as f64;
    Ok(Work {
        views,
        cells_secs: vec![cell; summary.n_cells],
        coordinator_secs: secs(&|phase| phase != "views" && phase != "cells"),
    })
}
