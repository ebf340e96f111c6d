//! `bench`.

use std::path::PathBuf;
use std::time::Duration;

use crate::bench::goal::time_goal;
use crate::bench::http::time_http;
use crate::bench::load::{self, LoadOptions};
use crate::bench::objects::time_objects;
use crate::bench::pause::{self, PauseOptions};
use crate::bench::query::bench_query;
use crate::bench::text::{self, TextSettings};
use crate::bench::{Settings, dump_ids, dump_vectors, make_queries};
use crate::goal::{GoalRequest, GoalTarget};
use crate::score::Precision;
use crate::store::Snapshot;
use anyhow::{Context, anyhow};
use clap::{Args, Subcommand};
use slag_common::shard::ShardView;

use super::args::{CacheArgs, ModelArgs, ThreadArgs, text_model};
use super::failure::{Failure, store_failure};
use super::output::print_json;

#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Time answers from the cache, without text model and HTTP.
    Query(BenchQueryArgs),
    /// Measure the longest wait of a query while fetches replace the generation.
    Pause(PauseArgs),
    /// Time `GET /v1/goal`, the search for places to stand, in a made yard.
    Goal(BenchGoalArgs),
    /// Load a service with more queries than it can answer.
    Load(LoadArgs),
    /// Time the text model.
    Text(BenchTextArgs),
}

#[derive(Debug, Args)]
pub struct BenchGoalArgs {
    /// How far around the robot ground is looked at.
    #[arg(long, value_name = "M", default_value_t = 20.0)]
    range_m: f64,
    /// Edge of a voxel.
    #[arg(long, value_name = "M", default_value_t = 0.05)]
    voxel_m: f64,
    /// Searches.
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// Work folder [default: a new temporary folder].
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    #[command(flatten)]
    threads: ThreadArgs,
}

#[derive(Debug, Args)]
pub struct PauseArgs {
    /// Gaussians of the generated scene.
    #[arg(long, value_name = "N", default_value_t = 1_000_000, value_parser = clap::value_parser!(u32).range(1000..=16_000_000))]
    gaussians: u32,
    /// Components of an embedding.
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(2..=8192))]
    dim: u32,
    /// Number of generations to fetch, one after the other.
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=1000))]
    fetches: u32,
    /// Work folder [default: a new temporary folder].
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct LoadArgs {
    /// Address of the service, as printed by `slag-edge serve`.
    #[arg(long, value_name = "URL")]
    url: String,
    /// Text to look for.
    #[arg(long, default_value = "red")]
    text: String,
    /// The rest of the query string: costlier questions, with which refusals cost less than answers.
    #[arg(long, value_name = "NAME=VALUE&...", default_value = "limit=10")]
    with: String,
    /// Queries per second, as a multiple of the service's capacity.
    #[arg(long, value_name = "X", default_value_t = 10.0)]
    overload: f64,
    /// Most queries at a time.
    #[arg(long, value_name = "N", default_value_t = 320, value_parser = clap::value_parser!(u32).range(1..=4096))]
    clients: u32,
    /// Duration.
    #[arg(long, value_name = "S", default_value_t = 600)]
    seconds: u64,
    /// Process to sample the memory of (Linux).
    #[arg(long, value_name = "PID")]
    pid: Option<u32>,
}

#[derive(Debug, Args)]
pub struct BenchQueryArgs {
    #[command(flatten)]
    cache: CacheArgs,
    #[command(flatten)]
    threads: ThreadArgs,
    /// Numbers of Gaussians to ask for.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [1_000, 10_000, 50_000, 100_000])]
    limits: Vec<usize>,
    /// Data that scores come from.
    #[arg(long, value_name = "centroids|measured|exact", default_value_t = Precision::Exact)]
    precision: Precision,
    /// Timed queries for each limit and kind of answer.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// Query vectors to use in turn, little-endian f32, unit length [default: 32 generated ones, half in
    /// random directions, half similar to embeddings of the scene].
    #[arg(long, value_name = "FILE")]
    queries: Option<PathBuf>,
    /// Seed of the generated queries.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write vectors.f32, queries.f32 and meta.json to a folder, for other engines.
    #[arg(long, value_name = "DIR")]
    dump: Option<PathBuf>,
    /// Write the results to a folder, as indices into vectors.f32: PROFILE-LIMIT-QUERY.u32.
    #[arg(long, value_name = "DIR")]
    ids: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct BenchTextArgs {
    #[command(flatten)]
    models: ModelArgs,
    /// Text to time; may be repeated.
    #[arg(long, default_values = ["chair", "a red fire extinguisher on the wall beside the door"])]
    text: Vec<String>,
    /// Timed runs of each text.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
}

/// Untimed runs of a text before the timed ones.
const N_TEXT_WARM_UP: usize = 10;
/// Number of generated queries.
const N_QUERIES: usize = 32;
/// Untimed queries before the timed ones.
const N_WARM_UP: usize = 5;

/// Duration of the queries without fetches, as a baseline.
const IDLE: Duration = Duration::from_secs(2);
/// Time to measure a service's capacity without overload.
const WARM_UP: Duration = Duration::from_secs(2);

pub fn run(command: BenchCommand) -> Result<(), Failure> {
    match command {
        BenchCommand::Query(args) => bench_query_command(args),
        BenchCommand::Goal(args) => {
            args.threads.apply()?;
            let request = GoalRequest { range_m: args.range_m, ..GoalRequest::new(GoalTarget::Object(0)) };
            request.check().map_err(|e| Failure::Usage(e.into()))?;
            let work_dir = args.work.unwrap_or_else(|| temporary("goal"));
            let report = time_goal(args.range_m, args.voxel_m, u64::from(args.runs), &work_dir);
            print_json(&report.map_err(|e| Failure::Failed("bench", e.into()))?)
        }
        BenchCommand::Pause(args) => bench_pause(args),
        BenchCommand::Load(args) => bench_load(args),
        BenchCommand::Text(args) => bench_text(args),
    }
}

fn bench_query_command(args: BenchQueryArgs) -> Result<(), Failure> {
    args.threads.apply()?;
    let cache = args.cache.open()?;
    let snapshot = Snapshot::open(&cache).map_err(store_failure)?;
    let shards: Vec<ShardView<'_>> = snapshot.shards.iter().map(|shard| shard.view()).collect();
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
            "there is nothing to measure: no query vector, or no shard on board"
        )));
    }
    let failed = |error: anyhow::Error| Failure::Failed("bench", error);
    if let Some(dir) = &args.dump {
        dump_vectors(dir, &shards, &queries).map_err(|e| failed(e.into()))?;
    }
    if let Some(dir) = &args.ids {
        let name = snapshot.current.profile.name();
        dump_ids(dir, name, &shards, &queries, &args.limits, args.precision).map_err(|e| failed(e.into()))?;
    }
    let settings = Settings {
        limits: args.limits,
        precision: args.precision,
        n_runs: args.runs as usize,
        n_warm_up: N_WARM_UP,
    };
    let mut report = bench_query(&snapshot, &queries, &settings).map_err(|e| failed(e.into()))?;
    report.objects = time_objects(&cache, &snapshot, queries.clone(), &settings)
        .map_err(|e| failed(anyhow::Error::new(e).context("timing answers of objects")))?;
    report.http = time_http(&cache, &snapshot, queries, &settings, &report.in_process)
        .map_err(|e| failed(anyhow::Error::new(e).context("timing the service on loopback")))?;
    print_json(&report)
}

fn bench_text(args: BenchTextArgs) -> Result<(), Failure> {
    let failed = Failure::of("models");
    let (models, options) = text_model(&args.models)?;
    let encoder = models.text_encoder(&options);
    let settings = TextSettings {
        texts: args.text,
        n_runs: args.runs as usize,
        n_warm_up: N_TEXT_WARM_UP,
        model_threads: options.intra_op_threads,
    };
    let report = text::run(&mut *encoder.map_err(|e| failed(e.into()))?, &settings);
    print_json(&report.map_err(|e| failed(e.into()))?)
}

fn bench_pause(args: PauseArgs) -> Result<(), Failure> {
    let options = PauseOptions {
        n_gaussians: args.gaussians,
        dim: args.dim,
        n_fetches: args.fetches,
        idle: IDLE,
        work_dir: args.work.unwrap_or_else(|| temporary("pause")),
    };
    print_json(&pause::run(&options).map_err(|e| Failure::Failed("bench", e.into()))?)
}

fn temporary(of: &str) -> PathBuf {
    std::env::temp_dir().join(format!("slag-bench-{of}-{}", std::process::id()))
}

fn bench_load(args: LoadArgs) -> Result<(), Failure> {
    if !(0.01..=1e4).contains(&args.overload) {
        return Err(Failure::Usage(anyhow!("the overload is {}, expected 0.01 to 10000", args.overload)));
    }
    let address = args.url.trim_end_matches('/').strip_prefix("http://");
    let advice = || Failure::Usage(anyhow!("{:?} is not an address like http://127.0.0.1:7734", args.url));
    let text: String = args.text.bytes().map(percent_encoded).collect();
    let options = LoadOptions {
        address: address.ok_or_else(advice)?.to_owned(),
        path: format!("/query?text={text}&{}", args.with),
        n_clients: args.clients as usize,
        overload: args.overload,
        warm_up: WARM_UP,
        duration: Duration::from_secs(args.seconds),
        pid: args.pid,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let report = runtime.block_on(load::run(&options)).context("the load ended early");
    print_json(&report.map_err(Failure::of("bench"))?)
}

fn percent_encoded(byte: u8) -> String {
    match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' => char::from(byte).to_string(),
        other => format!("%{other:02X}"),
    }
}
