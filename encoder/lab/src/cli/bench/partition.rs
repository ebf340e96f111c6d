//! `bench partition`.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::Args;

use super::sibling::sibling;
use crate::bench::partition::{self, LinkSpeed, PartitionSettings};
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::print;
use slag_encoder::progress::Progress;

/// `bench partition`.
#[derive(Debug, Args)]
pub struct PartitionArgs {
    /// Folder for the report and its plots.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Gaussians of the generated site, rounded down to multiples of 62,500.
    #[arg(long, value_name = "N", default_value_t = 1_000_000, value_parser = clap::value_parser!(u32).range(1000..=16_000_000))]
    gaussians: u32,
    /// Components of an embedding.
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(2..=4096))]
    dim: u32,
    /// Width of the site, metres.
    #[arg(long, value_name = "M", default_value_t = 400.0, value_parser = metres)]
    site_width_m: f64,
    /// Largest widths of cells, metres.
    #[arg(long, value_name = "M,...", value_delimiter = ',', default_values_t = [10.0, 15.0, 25.0, 50.0, 100.0], value_parser = metres)]
    cell_width_m: Vec<f64>,
    /// Most Gaussians in a cell.
    #[arg(long, value_name = "N", default_value_t = 65_536, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    cell_gaussians: u32,
    /// Radii around the robot, metres.
    #[arg(long, value_name = "M,...", value_delimiter = ',', default_values_t = [10.0, 25.0, 50.0, 100.0], value_parser = metres)]
    radius: Vec<f64>,
    /// Places of the robot for each radius.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    places: u32,
    /// Rate of the link towards the robot, Mbit/s.
    #[arg(long, value_name = "R", default_value_t = 20.0, value_parser = metres)]
    link_mbit: f64,
    /// Delay of a request on the link, milliseconds.
    #[arg(long, value_name = "MS", default_value_t = 20, value_parser = clap::value_parser!(u64).range(0..=10_000))]
    link_delay_ms: u64,
}

fn metres(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|v| (0.01..=1e6).contains(v));
    value.ok_or_else(|| "expected a number from 0.01 to 1000000".into())
}

pub(super) fn run(args: &PartitionArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let (encoder, edge) = (sibling("slag-encoder")?, sibling("slag-edge")?);
    for program in [&encoder, &edge] {
        if !program.is_file() {
            bail!("{} does not exist; build it first", program.display());
        }
    }
    let settings = PartitionSettings {
        n_gaussians: args.gaussians as usize,
        dim: args.dim as usize,
        site_width_m: args.site_width_m,
        cell_widths_m: args.cell_width_m.clone(),
        max_gaussians: args.cell_gaussians as usize,
        radii_m: args.radius.clone(),
        n_places: args.places as usize,
        link: LinkSpeed { bits_per_s: args.link_mbit * 1e6, delay_ms: args.link_delay_ms },
        out: args.out.clone(),
        encoder,
        edge,
    };
    let report = partition::run(&settings, progress)?;
    print(json, &report, &report)?;
    Ok(Exit::Done)
}
