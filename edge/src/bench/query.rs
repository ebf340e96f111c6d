//! How fast questions are answered: times over a cache, and the files that other engines are timed on.

use std::time::{Duration, Instant};

use half::f16;
use rayon::prelude::*;
use serde::Serialize;
use slag_common::shard::{BLOCK, Positions, Profile, ShardView};

use super::Random;
pub use super::dump::{DumpError, dump_ids, dump_vectors};
pub use super::http::{HttpTiming, time_http};
pub use super::machine::{Machine, Memory, read_bandwidth};
pub use super::objects::{ObjectsTiming, time_objects};
use crate::score::{Columns, Effort, Hit, Matches, Precision, Question, Region, ScoreError, Scratch, Search};
use crate::store::{OpenShard, Snapshot};

/// How much of a query like those of a bank of texts is an embedding of the scene: text and image vectors
/// of one thing have cosines around this (CLIP).
const LIKENESS: f32 = 0.3;
/// Queries that recall is taken from: exact answers take their time.
const N_RECALL: usize = 16;

/// What is measured.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Result sizes.
    pub limits: Vec<usize>,
    /// Which data scores come from.
    pub precision: Precision,
    /// Timed questions for each size and kind of answer; queries take turns.
    pub n_runs: usize,
    /// Untimed questions before them.
    pub n_warm_up: usize,
}

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// The machine.
    pub machine: Machine,
    /// What was asked about.
    pub scene: SceneSize,
    /// Which data scores come from.
    pub precision: Precision,
    /// Distinct query vectors.
    pub n_queries: usize,
    /// Memory of the process after all questions.
    pub memory: Memory,
    /// What a plain loop over memory reads with the same threads, in the same run.
    pub read_bytes_per_s: f64,
    /// Times in process: from the query's vector to columns of Gaussians, scores and positions.
    pub in_process: Vec<Timing>,
    /// Times of answers of objects in process; absent where the scene has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub objects: Option<ObjectsTiming>,
    /// Times of the best through the service on loopback, as Arrow columns.
    pub http: Vec<HttpTiming>,
}

/// What was asked about.
#[derive(Clone, Debug, Serialize)]
pub struct SceneSize {
    /// Profile of the shards.
    pub profile: Profile,
    /// Gaussians.
    pub n_gaussians: u64,
    /// Those with an embedding.
    pub n_with_evidence: u64,
    /// Shards.
    pub n_shards: usize,
    /// Codebook rows.
    pub n_centroids: u64,
    /// Components of an embedding.
    pub dim: usize,
    /// Bytes of all shards.
    pub shard_bytes: u64,
}

/// A kind of answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// The best so many, in order.
    Best,
    /// All that reach the score of the last of those.
    Threshold,
}

/// Times of one kind of answer at one size.
#[derive(Clone, Debug, Serialize)]
pub struct Timing {
    /// Kind of answer.
    pub kind: Kind,
    /// Size asked for.
    pub limit: usize,
    /// Timed questions.
    pub n_runs: usize,
    /// Fewest and most Gaussians found.
    pub n_found: [usize; 2],
    /// Half of the questions took no longer.
    pub median_ms: f64,
    /// 99 of 100 took no longer.
    pub p99_ms: f64,
    /// The shortest.
    pub min_ms: f64,
    /// Share of the exact answer that is found, mean over queries; absent where answers are exact, or the shards
    /// have no exact embeddings to tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recall: Option<f64>,
    /// Bytes of the shards that a question reads, median.
    pub bytes_touched: u64,
    /// What reading those takes in a plain loop.
    pub plain_read_ms: f64,
    /// The median by that.
    pub times_plain_read: f64,
}

/// Makes query vectors: every other one in a random direction, the rest as like an embedding of the scene
/// as a text's vector is to what it names. Same seed, same vectors.
pub fn make_queries(shards: &[ShardView<'_>], n: usize, seed: u64) -> Vec<Vec<f32>> {
    let mut random = Random(seed);
    let mut queries = Vec::with_capacity(n.min(1 << 16));
    let dim = shards.first().map_or(0, |shard| shard.header.dim as usize);
    let known: Vec<&ShardView<'_>> = shards.iter().filter(|shard| shard.n_with_evidence() > 0).collect();
    for at in 0..n {
        let mut query: Vec<f64> = (0..dim).map(|_| random.normal()).collect();
        normalise(&mut query);
        if at % 2 == 1 && !known.is_empty() {
            let shard = known[random.below(known.len())];
            let mut like = vec![0.0; dim];
            shard.decode(random.below(shard.n_with_evidence()), &mut like);
            normalise(&mut like);
            let rest = f64::from((1.0 - LIKENESS * LIKENESS).sqrt());
            query.iter_mut().zip(like).for_each(|(q, l)| *q = *q * rest + l * f64::from(LIKENESS));
            normalise(&mut query);
        }
        queries.push(query.into_iter().map(|v| v as f32).collect());
    }
    queries
}

pub(super) fn normalise(vector: &mut [f64]) {
    let length = vector.iter().map(|v| v * v).sum::<f64>().sqrt();
    if length > 0.0 {
        vector.iter_mut().for_each(|v| *v /= length);
    }
}

/// Times questions to a snapshot. `queries`: `[dim]` each, unit length; at least one.
///
/// # Errors
/// [`ScoreError`].
pub fn bench_query(
    snapshot: &Snapshot,
    queries: &[Vec<f32>],
    settings: &Settings,
) -> Result<Report, ScoreError> {
    let shards: Vec<ShardView<'_>> = snapshot.shards.iter().map(OpenShard::view).collect();
    let mut answer = Answer::default();
    let mut timed = Vec::new();
    for limit in &settings.limits {
        for kind in [Kind::Best, Kind::Threshold] {
            let runs = answer.time(&shards, queries, kind, *limit, settings)?;
            let recall = recall(&shards, queries, kind, *limit, settings.precision)?;
            timed.push((kind, *limit, runs, recall));
        }
    }
    let memory = Memory::now();
    let read_bytes_per_s = read_bandwidth();
    let in_process = timed
        .into_iter()
        .map(|(kind, limit, runs, recall)| Timing { recall, ..timing(kind, limit, runs, read_bytes_per_s) });
    Ok(Report {
        machine: Machine::here(),
        scene: SceneSize {
            profile: snapshot.current.profile,
            n_gaussians: shards.iter().map(|shard| u64::from(shard.header.n_gaussians)).sum(),
            n_with_evidence: shards.iter().map(|shard| shard.n_with_evidence() as u64).sum(),
            n_shards: shards.len(),
            n_centroids: shards.iter().map(|shard| u64::from(shard.header.n_centroids)).sum(),
            dim: shards.first().map_or(0, |shard| shard.header.dim as usize),
            shard_bytes: snapshot.shards.iter().map(OpenShard::len_bytes).sum(),
        },
        precision: settings.precision,
        n_queries: queries.len(),
        memory,
        read_bytes_per_s,
        in_process: in_process.collect(),
        objects: None,
        http: Vec::new(),
    })
}

/// One timed question.
struct Run {
    took: Duration,
    n_found: usize,
    bytes: u64,
}

/// What a process that answers many questions keeps.
#[derive(Default)]
struct Answer {
    scratch: Scratch,
    hits: Vec<Hit>,
    matches: Matches,
    columns: Columns,
}

impl Answer {
    fn time(
        &mut self,
        shards: &[ShardView<'_>],
        queries: &[Vec<f32>],
        kind: Kind,
        limit: usize,
        settings: &Settings,
    ) -> Result<Vec<Run>, ScoreError> {
        let questions: Vec<Question> = queries.iter().map(|query| Question::new(&query[..])).collect();
        let mut runs = Vec::new();
        for at in 0..settings.n_warm_up + settings.n_runs {
            let question = &questions[at % questions.len()];
            let threshold = match kind {
                Kind::Best => f32::NEG_INFINITY,
                Kind::Threshold => {
                    let search = self.search(shards, question, settings.precision)?;
                    search.best(limit, f32::NEG_INFINITY, None).last().map_or(1.0, |hit| hit.score)
                }
            };
            let start = Instant::now();
            let search = self.search(shards, question, settings.precision)?;
            let effort = match kind {
                Kind::Best => {
                    let effort = search.best_into(limit, threshold, None, &mut self.hits);
                    self.columns.set_hits(shards, &self.hits);
                    effort
                }
                Kind::Threshold => {
                    search.matching_into(threshold, &mut self.matches);
                    self.columns.set_runs(shards, &self.matches.runs);
                    self.matches.effort
                }
            };
            let took = start.elapsed();
            if at >= settings.n_warm_up {
                let n_found = self.columns.len();
                runs.push(Run { took, n_found, bytes: bytes_touched(shards, effort, &self.columns) });
            }
        }
        Ok(runs)
    }

    fn search<'a>(
        &mut self,
        shards: &'a [ShardView<'a>],
        question: &'a Question,
        precision: Precision,
    ) -> Result<Search<'a>, ScoreError> {
        Search::reusing(&mut self.scratch, shards, question, Region::default(), precision)
    }
}

/// Returns the share of the exact answers that is found, over some of the queries.
fn recall(
    shards: &[ShardView<'_>],
    queries: &[Vec<f32>],
    kind: Kind,
    limit: usize,
    precision: Precision,
) -> Result<Option<f64>, ScoreError> {
    let has_truth = shards.iter().all(|shard| shard.exact.is_some());
    if kind == Kind::Threshold || precision == Precision::Exact || !has_truth {
        return Ok(None);
    }
    let queries = &queries[..queries.len().min(N_RECALL)];
    let mut sum = 0.0;
    for query in queries {
        let question = Question::new(&query[..]);
        let best = |precision| -> Result<Vec<(u32, u32)>, ScoreError> {
            let search = Search::new(shards, &question, Region::default(), precision)?;
            let hits = search.best(limit, f32::NEG_INFINITY, None);
            let mut names: Vec<(u32, u32)> = hits.iter().map(|hit| (hit.shard, hit.index)).collect();
            names.sort_unstable();
            Ok(names)
        };
        let (truth, found) = (best(Precision::Exact)?, best(precision)?);
        let n = found.iter().filter(|name| truth.binary_search(name).is_ok()).count();
        sum += n as f64 / truth.len().max(1) as f64;
    }
    Ok(Some(sum / queries.len() as f64))
}

/// Returns the least of some sorted values, at least one, that so large a share of them does not exceed.
pub(super) fn quantile<T: Copy>(sorted: &[T], share: f64) -> T {
    sorted[((sorted.len() as f64 * share).ceil() as usize).clamp(1, sorted.len()) - 1]
}

fn timing(kind: Kind, limit: usize, runs: Vec<Run>, read_bytes_per_s: f64) -> Timing {
    let mut millis: Vec<f64> = runs.iter().map(|run| run.took.as_secs_f64() * 1e3).collect();
    millis.sort_by(f64::total_cmp);
    let mut bytes: Vec<u64> = runs.iter().map(|run| run.bytes).collect();
    bytes.sort_unstable();
    let (median_ms, bytes_touched) = (quantile(&millis, 0.5), quantile(&bytes, 0.5));
    let plain_read_ms = bytes_touched as f64 / read_bytes_per_s * 1e3;
    let found = || runs.iter().map(|run| run.n_found);
    Timing {
        kind,
        limit,
        n_runs: runs.len(),
        n_found: [found().min().unwrap_or(0), found().max().unwrap_or(0)],
        median_ms,
        p99_ms: quantile(&millis, 0.99),
        recall: None,
        min_ms: millis[0],
        bytes_touched,
        plain_read_ms,
        times_plain_read: median_ms / plain_read_ms,
    }
}

/// Returns the bytes of the shards that an answer was made of: what belongs to rows, bases and words whole,
/// and of codes, embeddings and positions what was read.
fn bytes_touched(shards: &[ShardView<'_>], effort: Effort, found: &Columns) -> u64 {
    let of_shard = |shard: &ShardView<'_>| {
        let basis = shard.basis.map_or(0, |b| b.vectors.len() + 2 * b.mean.len() + 4 * b.steps.len());
        let residuals = shard.residuals.map_or(0, |r| 2 * r.codewords.len() + 8 * r.residual_scales.len());
        let radii = if shard.exact.is_some() { 4 * shard.radii.len() } else { 0 };
        (shard.centroids.len() + 4 * shard.centroid_starts.len() + basis + residuals + radii) as u64
    };
    let first = shards.first();
    let block = first.map_or(0, |shard| BLOCK as u64 * u64::from(shard.header.n_subspaces) / 2);
    let (dim, m) = first.map_or((0, 0), |shard| (shard.header.dim, shard.header.n_components));
    let position = first.map_or(0, |shard| match shard.positions {
        Positions::Packed(_) => 4,
        Positions::Wide(_) => 6,
    });
    shards.par_iter().map(of_shard).sum::<u64>()
        + effort.n_blocks_read * block
        + effort.n_fine_read * u64::from(m)
        + effort.n_embeddings_read * u64::from(dim) * size_of::<f16>() as u64
        + found.len() as u64 * position
}
