//! `bench fleet`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use crate::bench::fleet::{self, FleetReport, Links};
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::print;

/// `bench fleet`.
#[derive(Debug, Args)]
pub struct FleetArgs {
    /// Store of the measured encode, made with `encode --keep-views`.
    #[arg(long, value_name = "DIR")]
    store: PathBuf,
    /// What `encode --json` printed of it.
    #[arg(long, value_name = "FILE")]
    summary: PathBuf,
    /// Views of the simulated scene: the measured one, over and over.
    #[arg(long, value_name = "N", default_value_t = 10_000, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    views: u32,
    /// Seconds of a machine a view, on average, for other models; views differ by the same factors [default: as measured].
    #[arg(long, value_name = "S", value_parser = positive)]
    view_secs: Option<f64>,
    /// Most machines.
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    machines: u32,
    /// Rate between a machine and the bucket, Mbit/s.
    #[arg(long, value_name = "R", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..))]
    worker_mbit: u32,
    /// Rate between the coordinator and the bucket, Mbit/s.
    #[arg(long, value_name = "R", default_value_t = 10_000, value_parser = clap::value_parser!(u32).range(1..))]
    coordinator_mbit: u32,
    /// Time from one piece of work to the next, milliseconds.
    #[arg(long, value_name = "MS", default_value_t = 20, value_parser = clap::value_parser!(u32).range(0..=60_000))]
    dispatch_ms: u32,
    /// File for the plot.
    #[arg(long, value_name = "FILE.svg")]
    svg: Option<PathBuf>,
}

fn positive(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|v| (1e-6..=1e6).contains(v));
    value.ok_or_else(|| "expected seconds, more than 0".into())
}

pub(super) fn run(args: &FleetArgs, json: bool) -> Result<Exit> {
    let mut work = fleet::measured(&args.store, &args.summary)?;
    if let Some(secs) = args.view_secs {
        work = work.with_view_secs(secs);
    }
    let work = work.repeated(args.views as usize);
    let links = Links {
        worker_bits_per_s: f64::from(args.worker_mbit) * 1e6,
        coordinator_bits_per_s: f64::from(args.coordinator_mbit) * 1e6,
        dispatch_secs: f64::from(args.dispatch_ms) / 1e3,
    };
    let report = FleetReport::simulate(&work, &links, args.machines as usize);
    if let Some(path) = &args.svg {
        fs_err::write(path, report.svg())?;
    }
    print(json, &report, &report)?;
    Ok(Exit::Done)
}
