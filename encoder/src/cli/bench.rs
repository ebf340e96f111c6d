//! `bench`.

use anyhow::{Context, Result};

use super::Exit;
use super::args::LiftBenchArgs;
use super::run::{available_threads, print};
use crate::bench::lift::{self, LiftOptions};

pub(super) fn run_lift(args: &LiftBenchArgs, json: bool) -> Result<Exit> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads.map_or_else(available_threads, |n| n as usize))
        .build_global()
        .context("cannot start threads")?;
    let in_temporary = || std::env::temp_dir().join(format!("slag-bench-lift-{}", std::process::id()));
    let options = LiftOptions {
        n_gaussians: args.gaussians as usize,
        n_views: args.views as usize,
        n_masks: args.masks as usize,
        n_visible: args.visible as usize,
        entries_per_visible: args.entries_per_visible,
        dim: args.dim as usize,
        cell_gaussians: args.cell_gaussians as usize,
        memory_bytes: args.memory,
        n_repeats: args.repeats as usize,
        work_dir: args.work.clone().unwrap_or_else(in_temporary),
        plan: (args.plan_gaussians as usize, args.plan_views as usize),
    };
    let measured = lift::run(&options);
    lift::clean(&options)?;
    let report = measured?;
    if let Some(path) = &args.out {
        fs_err::write(path, serde_json::to_string_pretty(&report)?)?;
    }
    print(json, &report, &report)?;
    Ok(Exit::Done)
}
