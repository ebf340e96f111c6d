//! `bench robot`.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::Args;

use super::sibling::sibling;
use crate::bench::robot::{self, Engine, RobotSettings};
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::print;
use slag_encoder::cli::memory::free_memory_bytes;
use slag_encoder::progress::Progress;

/// `bench robot`.
#[derive(Debug, Args)]
pub struct RobotArgs {
    /// Folder for robot.json, robot.md and the figures; what was measured there before is not measured again.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Numbers of Gaussians.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [1_000_000, 2_000_000, 4_000_000, 8_000_000], value_parser = clap::value_parser!(u64).range(1000..=100_000_000))]
    gaussians: Vec<u64>,
    /// Components of an embedding.
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(2..=4096))]
    dim: u32,
    /// Numbers of results.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [1_000, 10_000, 50_000, 100_000], value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    limits: Vec<u64>,
    /// What to time: profiles of slag-edge, and engines of slag-bench-rivals. NAME=GAUSSIANS leaves an engine out at
    /// larger sizes: a graph of millions takes hours to build.
    #[arg(
        long,
        value_name = "NAME[=MOST],...",
        value_delimiter = ',',
        default_value = "compact,balanced,dense,qdrant-scan,qdrant-scan-int8,qdrant-hnsw,qdrant-hnsw-int8,qdrant-hnsw-pq,usearch-hnsw,usearch-hnsw-int8"
    )]
    engines: Vec<Engine>,
    /// Timed queries of each number of results.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
    runs: u32,
    /// The program slag-bench-rivals; without it the other engines are left out.
    #[arg(long, value_name = "FILE")]
    rivals: Option<PathBuf>,
    /// Text model to time [default: the embedded one].
    #[arg(long, value_name = "NAME|DIR")]
    models: Option<PathBuf>,
}

pub(super) fn run(args: &RobotArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let (encoder, edge) = (sibling("slag-encoder")?, sibling("slag-edge")?);
    for program in [&encoder, &edge].into_iter().chain(&args.rivals) {
        if !program.is_file() {
            bail!("{} does not exist; build it first", program.display());
        }
    }
    let models = args.models.iter().flat_map(|path| ["--models".into(), path.display().to_string()]);
    let settings = RobotSettings {
        sizes: args.gaussians.clone(),
        dim: args.dim,
        limits: args.limits.clone(),
        engines: args.engines.clone(),
        n_runs: args.runs,
        free_memory_bytes: free_memory_bytes(),
        out: args.out.clone(),
        encoder,
        edge,
        rivals: args.rivals.clone(),
        models: models.collect(),
    };
    let report = robot::run(&settings, progress)?;
    print(json, &report, &report)?;
    Ok(if report.not_run.is_empty() { Exit::Done } else { Exit::Partly })
}
