//! `bench`.

use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::{Args, Subcommand};
use slag_common::shard::ShardView;
use slag_edge::bench::{Settings, bench_query, dump_ids, dump_vectors, make_queries};
use slag_edge::store::{OpenShard, Snapshot};

use super::commands::store_failure;
use super::output::{Failure, print_json};
use super::{CacheArgs, ThreadArgs};

/// What is measured.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Times questions to what is on board, without text model and HTTP; prints JSON.
    Query(BenchQueryArgs),
}

#[derive(Debug, Args)]
pub struct BenchQueryArgs {
    #[command(flatten)]
    cache: CacheArgs,
    #[command(flatten)]
    threads: ThreadArgs,
    /// Sizes of answers.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [1_000, 10_000, 50_000, 100_000])]
    limits: Vec<usize>,
    /// Timed questions for each size and kind of answer.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// Query vectors in turn, little-endian f32, of unit length [default: 32 made ones, half of them in random
    /// directions, half like embeddings of the scene].
    #[arg(long, value_name = "FILE")]
    queries: Option<PathBuf>,
    /// Seed of the made queries.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Writes vectors.f32, queries.f32 and meta.json to a folder, for other engines.
    #[arg(long, value_name = "DIR")]
    dump: Option<PathBuf>,
    /// Writes what the queries find to a folder, as places in vectors.f32: PROFILE-LIMIT-QUERY.u32.
    #[arg(long, value_name = "DIR")]
    ids: Option<PathBuf>,
}

/// Made queries.
const N_QUERIES: usize = 32;
/// Untimed questions before the timed ones.
const N_WARM_UP: usize = 5;

pub fn query(args: BenchQueryArgs) -> Result<(), Failure> {
    args.threads.apply()?;
    let snapshot = Snapshot::open(&args.cache.open()?).map_err(store_failure)?;
    let shards: Vec<ShardView<'_>> = snapshot.shards.iter().map(OpenShard::view).collect();
    let queries = match &args.queries {
        None => make_queries(&shards, N_QUERIES, args.seed),
        Some(path) => {
            let bytes =
                fs_err::read(path).context("reading the queries").map_err(|e| Failure::Failed("io", e))?;
            let floats = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
            let dim = snapshot.manifest.encoder.dim.max(1) as usize;
            let floats: Vec<f32> = floats.collect();
            floats.chunks_exact(dim).map(<[f32]>::to_vec).collect()
        }
    };
    if queries.is_empty() || shards.is_empty() {
        return Err(Failure::Usage(anyhow!(
            "there is nothing to ask: no query vector, or no shard on board"
        )));
    }
    let failed = |error: anyhow::Error| Failure::Failed("bench", error);
    if let Some(dir) = &args.dump {
        dump_vectors(dir, &shards, &queries).map_err(|e| failed(e.into()))?;
    }
    if let Some(dir) = &args.ids {
        let name = snapshot.current.profile.name();
        dump_ids(dir, name, &shards, &queries, &args.limits).map_err(|e| failed(e.into()))?;
    }
    let settings = Settings { limits: args.limits, n_runs: args.runs as usize, n_warm_up: N_WARM_UP };
    let report = bench_query(&snapshot, &queries, &settings).map_err(|e| failed(e.into()))?;
    print_json(&report)
}
