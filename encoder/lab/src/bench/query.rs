//! `bench query` and `bench text`: answers of the robot's engine over a cache, from a vector to columns of
//! Gaussians; and a text model, from words to a vector.

use std::hint::black_box;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clap::Args;
use rayon::prelude::*;
use serde::Serialize;
use serde_json::json;
use slag_common::shard::{Profile, ShardView};
use slag_edge::score::{Precision, Question, Region, Search};
use slag_edge::store::{EdgeCache, Snapshot};
use slag_encoder::cli::common::{ModelArgs, open_models};
use slag_math::random::Random;

use crate::harness::{Machine, Times, resident_bytes};

const N_QUERIES: usize = 32;
/// Untimed queries, and untimed runs of a text, before the timed ones.
const N_WARM_UP: usize = 5;
/// Weight of a scene's embedding in a query that resembles a text: text and image vectors of one thing have
/// cosines around this (CLIP).
const LIKENESS: f64 = 0.3;
const CHUNK: usize = 4096;

#[derive(Debug, Args)]
pub(crate) struct QueryArgs {
    /// The robot's cache.
    #[arg(long, value_name = "DIR")]
    cache: PathBuf,
    /// Numbers of Gaussians to ask for.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [1_000, 10_000, 50_000, 100_000])]
    limits: Vec<usize>,
    /// Data that scores come from.
    #[arg(long, value_name = "centroids|measured|exact", default_value_t = Precision::Exact)]
    precision: Precision,
    /// Timed queries for each limit and kind of answer.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
    /// Query vectors to use in turn, little-endian f32, unit length [default: 32 generated ones, half in random
    /// directions, half similar to embeddings of the scene].
    #[arg(long, value_name = "FILE")]
    queries: Option<PathBuf>,
    /// Writes vectors.f32, queries.f32 and meta.json to a folder, for other engines.
    #[arg(long, value_name = "DIR")]
    dump: Option<PathBuf>,
    /// Writes the results to a folder, as indices into vectors.f32: PROFILE-LIMIT-QUERY.u32.
    #[arg(long, value_name = "DIR")]
    ids: Option<PathBuf>,
}

#[derive(Debug, Serialize)]
pub(crate) struct QueryReport {
    machine: Machine,
    profile: Profile,
    n_gaussians: u64,
    n_with_evidence: u64,
    n_shards: usize,
    dim: usize,
    shard_bytes: u64,
    /// Resident memory of the process after all queries, pages of mapped shards included.
    rss_bytes: Option<u64>,
    searches: Vec<Timing>,
}

#[derive(Debug, Serialize)]
struct Timing {
    limit: usize,
    /// The best `limit`, in order.
    best: Times,
    /// All that reach the score of the last of those.
    threshold: Times,
}

pub(crate) fn run(args: &QueryArgs) -> Result<QueryReport> {
    let threads = args.threads.map_or(0, |n| n as usize);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global()?;
    let snapshot = Snapshot::open(&EdgeCache::open(&args.cache))?;
    let shards: Vec<ShardView<'_>> = snapshot.shards.iter().map(|shard| shard.view()).collect();
    let dim = snapshot.manifest.encoder.dim.max(1) as usize;
    let queries = match &args.queries {
        None => made_queries(&shards, dim),
        Some(path) => {
            let bytes = fs_err::read(path)?;
            let floats = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
            floats.collect::<Vec<f32>>().chunks_exact(dim).map(<[f32]>::to_vec).collect()
        }
    };
    if queries.is_empty() || shards.is_empty() {
        bail!("there is nothing to measure: no query vector, or no shard in {}", args.cache.display());
    }
    if let Some(dir) = &args.dump {
        dump_vectors(dir, &shards, &queries, dim)?;
    }
    let profile = snapshot.current.profile;
    if let Some(dir) = &args.ids {
        dump_ids(dir, profile, &shards, &queries, args)?;
    }
    let questions: Vec<Question> = queries.iter().map(|query| Question::new(&query[..])).collect();
    let time = |limit: &usize| time(&shards, &questions, *limit, args);
    Ok(QueryReport {
        searches: args.limits.iter().map(time).collect::<Result<_>>()?,
        machine: Machine::here(),
        profile,
        n_gaussians: shards.iter().map(|shard| u64::from(shard.header.n_gaussians)).sum(),
        n_with_evidence: shards.iter().map(|shard| shard.n_with_evidence() as u64).sum(),
        n_shards: shards.len(),
        dim,
        shard_bytes: snapshot.shards.iter().map(|shard| shard.len_bytes()).sum(),
        rss_bytes: resident_bytes(),
    })
}

/// Times both kinds of answers.
fn time(shards: &[ShardView<'_>], questions: &[Question], limit: usize, args: &QueryArgs) -> Result<Timing> {
    let position = |shard: u32, index: u32| shards[shard as usize].position_in_world(index as usize);
    let n_runs = args.runs as usize;
    let question = |turn: usize| &questions[turn % questions.len()];
    let best = Times::measure(N_WARM_UP, n_runs, |turn| -> Result<()> {
        let search = Search::new(shards, question(turn), Region::default(), args.precision)?;
        let hits = search.best(limit, f32::NEG_INFINITY, None).into_par_iter();
        black_box(hits.map(|hit| position(hit.shard, hit.index)).collect::<Vec<_>>());
        Ok(())
    })?;
    let last = |question: &Question| -> Result<f32> {
        let search = Search::new(shards, question, Region::default(), args.precision)?;
        Ok(search.best(limit, f32::NEG_INFINITY, None).last().map_or(1.0, |hit| hit.score))
    };
    let thresholds = questions.iter().map(last).collect::<Result<Vec<f32>>>()?;
    let threshold = Times::measure(N_WARM_UP, n_runs, |turn| -> Result<()> {
        let search = Search::new(shards, question(turn), Region::default(), args.precision)?;
        let runs = search.matching(thresholds[turn % thresholds.len()]).runs.into_par_iter();
        let positions = runs.flat_map_iter(|run| (run.start..run.end).map(move |at| position(run.shard, at)));
        black_box(positions.collect::<Vec<_>>());
        Ok(())
    })?;
    Ok(Timing { limit, best, threshold })
}

/// Returns unit vectors: every other one in a random direction, the rest as similar to an embedding of the scene
/// as a text's vector is to the thing that it names.
fn made_queries(shards: &[ShardView<'_>], dim: usize) -> Vec<Vec<f32>> {
    let mut random = Random::new(1);
    let known: Vec<&ShardView<'_>> = shards.iter().filter(|shard| shard.n_with_evidence() > 0).collect();
    let query = |at: usize| {
        let mut query: Vec<f64> = (0..dim).map(|_| random.normal()).collect();
        normalise(&mut query);
        if at % 2 == 1 && !known.is_empty() {
            let shard = known[random.below(known.len())];
            let mut like = vec![0.0; dim];
            shard.decode(random.below(shard.n_with_evidence()), &mut like);
            normalise(&mut like);
            let rest = (1.0 - LIKENESS * LIKENESS).sqrt();
            query.iter_mut().zip(like).for_each(|(q, l)| *q = *q * rest + l * LIKENESS);
            normalise(&mut query);
        }
        query.into_iter().map(|v| v as f32).collect()
    };
    (0..N_QUERIES).map(query).collect()
}

fn normalise(vector: &mut [f64]) {
    let length = vector.iter().map(|v| v * v).sum::<f64>().sqrt();
    if length > 0.0 {
        vector.iter_mut().for_each(|v| *v /= length);
    }
}

/// Writes `vectors.f32` (`[n][dim]`: all Gaussians with an embedding, shard by shard, decoded, unit length),
/// `queries.f32` (`[n_queries][dim]`) and `meta.json`; floats are little-endian.
fn dump_vectors(dir: &Path, shards: &[ShardView<'_>], queries: &[Vec<f32>], dim: usize) -> Result<()> {
    fs_err::create_dir_all(dir)?;
    let mut vectors = BufWriter::new(fs_err::File::create(dir.join("vectors.f32"))?);
    for shard in shards {
        let n = shard.n_with_evidence();
        for start in (0..n).step_by(CHUNK) {
            let decode = |index: usize| {
                let mut vector = vec![0.0; dim];
                shard.decode(index, &mut vector);
                normalise(&mut vector);
                vector.into_iter().flat_map(|v| (v as f32).to_le_bytes()).collect::<Vec<u8>>()
            };
            let decoded: Vec<Vec<u8>> = (start..n.min(start + CHUNK)).into_par_iter().map(decode).collect();
            decoded.iter().try_for_each(|bytes| vectors.write_all(bytes))?;
        }
    }
    vectors.flush()?;
    let bytes: Vec<u8> = queries.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    fs_err::write(dir.join("queries.f32"), bytes)?;
    let n: usize = shards.iter().map(ShardView::n_with_evidence).sum();
    let meta = json!({ "n": n, "dim": dim, "n_queries": queries.len() });
    Ok(fs_err::write(dir.join("meta.json"), meta.to_string())?)
}

/// Writes the results of each query, best first, as little-endian u32 indices into `vectors.f32`.
fn dump_ids(
    dir: &Path,
    profile: Profile,
    shards: &[ShardView<'_>],
    queries: &[Vec<f32>],
    args: &QueryArgs,
) -> Result<()> {
    fs_err::create_dir_all(dir)?;
    let mut first = vec![0u32];
    for shard in shards {
        first.push(first[first.len() - 1].saturating_add(shard.n_with_evidence() as u32));
    }
    for (at, query) in queries.iter().enumerate() {
        let question = Question::new(&query[..]);
        let search = Search::new(shards, &question, Region::default(), args.precision)?;
        for limit in &args.limits {
            let hits = search.best(*limit, f32::NEG_INFINITY, None);
            let ids = hits.iter().flat_map(|hit| (first[hit.shard as usize] + hit.index).to_le_bytes());
            fs_err::write(dir.join(format!("{profile}-{limit}-{at}.u32")), ids.collect::<Vec<u8>>())?;
        }
    }
    Ok(())
}

#[derive(Debug, Args)]
pub(crate) struct TextArgs {
    #[command(flatten)]
    pub(crate) models: ModelArgs,
    /// Text to time; may be repeated.
    #[arg(long, default_values = ["chair", "a red fire extinguisher on the wall beside the door"])]
    pub(crate) text: Vec<String>,
    /// Timed runs of each text.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub(crate) runs: u32,
}

#[derive(Debug, Serialize)]
pub(crate) struct TextReport {
    machine: Machine,
    pub(crate) model: String,
    /// The execution provider in use.
    runs_on: Option<String>,
    model_threads: usize,
    pub(crate) texts: Vec<(String, Times)>,
}

/// Encodes each text repeatedly, without the robot's cache of recent texts.
pub(crate) fn time_texts(args: &TextArgs) -> Result<TextReport> {
    let (models, session) = open_models(&args.models)?;
    let mut encoder = models.text_encoder(&session)?;
    let mut texts = Vec::new();
    for text in &args.text {
        let times = Times::measure(N_WARM_UP, args.runs as usize, |_| encoder.encode(text).map(|_| ()))?;
        texts.push((text.clone(), times));
    }
    Ok(TextReport {
        machine: Machine::here(),
        model: models.encoder_id().name.clone(),
        runs_on: encoder.placement().map(ToString::to_string),
        model_threads: session.intra_op_threads,
        texts,
    })
}
