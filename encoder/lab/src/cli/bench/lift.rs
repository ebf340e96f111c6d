//! `bench lift`.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{available_threads, print};
use slag_encoder::cli::memory::parse_memory;

use crate::bench::lift::{self, LiftOptions};

/// `bench lift`.
#[derive(Debug, Args)]
pub struct LiftBenchArgs {
    /// Gaussians.
    #[arg(long, value_name = "N", default_value_t = 2_000_000, value_parser = clap::value_parser!(u32).range(1..))]
    gaussians: u32,
    /// Views.
    #[arg(long, value_name = "N", default_value_t = 252, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    views: u32,
    /// Masks per view.
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    masks: u32,
    /// Gaussians with a contribution, per view.
    #[arg(long, value_name = "N", default_value_t = 400_000, value_parser = clap::value_parser!(u32).range(1..))]
    visible: u32,
    /// Mean contributions of each of these; a Gaussian near borders contributes to several regions.
    #[arg(long, value_name = "X", default_value_t = 1.4, value_parser = parse_ratio)]
    entries_per_visible: f64,
    /// Components of an embedding.
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(1..=8192))]
    dim: u32,
    /// Gaussians per cell at most.
    #[arg(long, value_name = "N", default_value_t = 65_536, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    cell_gaussians: u32,
    /// Working memory, as with `encode`.
    #[arg(long, value_name = "BYTES", default_value = "2GiB", value_parser = parse_memory)]
    memory: u64,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
    /// Repeats.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    repeats: u32,
    /// Folder for the files of contributions, removed afterwards [default: in the system's temporary folder].
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Gaussians of the scene to estimate.
    #[arg(long, value_name = "N", default_value_t = 38_000_000, value_parser = clap::value_parser!(u32).range(1..))]
    plan_gaussians: u32,
    /// Views of that scene.
    #[arg(long, value_name = "N", default_value_t = 1657, value_parser = clap::value_parser!(u32).range(1..))]
    plan_views: u32,
    /// Writes the figures as JSON into this file.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Parses a number of contributions per Gaussian.
fn parse_ratio(text: &str) -> Result<f64, String> {
    let ratio: f64 = text.parse().map_err(|_| format!("{text:?} is not a number"))?;
    if (1.0..=4.0).contains(&ratio) { Ok(ratio) } else { Err(format!("{text:?} is not within 1 to 4")) }
}

pub(super) fn run(args: &LiftBenchArgs, json: bool) -> Result<Exit> {
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
