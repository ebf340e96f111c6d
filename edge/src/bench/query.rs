//! Times answers over a cache.

use std::time::{Duration, Instant};

use half::f16;
use rayon::prelude::*;
use serde::Serialize;
use slag_common::shard::{BLOCK, Positions, Profile, ShardView};

use super::http::HttpTiming;
use super::machine::{Machine, Memory, read_bandwidth};
use super::objects::ObjectsTiming;
use super::timing::{Kind, Settings, Timing, quantile};
use crate::score::{Columns, Effort, Hit, Matches, Precision, Question, Region, ScoreError, Scratch, Search};
use crate::store::Snapshot;

/// Queries used to measure recall; exact answers take long.
const N_RECALL: usize = 16;

/// Report of the measurement.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// The machine.
    pub machine: Machine,
    /// The cache measured.
    pub scene: SceneSize,
    /// Data that scores come from.
    pub precision: Precision,
    /// Distinct query vectors.
    pub n_queries: usize,
    /// Memory of the process after all queries.
    pub memory: Memory,
    /// Read bandwidth of a plain loop over memory on the same threads, in the same run.
    pub read_bytes_per_s: f64,
    /// Times in process: from the query vector to columns of Gaussians, scores and positions.
    pub in_process: Vec<Timing>,
    /// Times of answers of objects in process; absent if the scene has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub objects: Option<ObjectsTiming>,
    /// Times of requests for the best Gaussians over loopback, as Arrow columns.
    pub http: Vec<HttpTiming>,
}

/// Size of the cache measured.
#[derive(Clone, Debug, Serialize)]
pub struct SceneSize {
    /// Profile of the shards.
    pub profile: Profile,
    /// Gaussians.
    pub n_gaussians: u64,
    /// Gaussians with an embedding.
    pub n_with_evidence: u64,
    /// Shards.
    pub n_shards: usize,
    /// Codebook centroids.
    pub n_centroids: u64,
    /// Components of an embedding.
    pub dim: usize,
    /// Bytes of all shards.
    pub shard_bytes: u64,
}

/// Times queries on a snapshot. `queries`: `[dim]` each, unit length; at least one.
///
/// # Errors
/// [`ScoreError`].
pub fn bench_query(
    snapshot: &Snapshot,
    queries: &[Vec<f32>],
    settings: &Settings,
) -> Result<Report, ScoreError> {
    let shards: Vec<ShardView<'_>> = snapshot.shards.iter().map(|shard| shard.view()).collect();
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
            shard_bytes: snapshot.shards.iter().map(|shard| shard.len_bytes()).sum(),
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

/// One timed query.
struct Run {
    took: Duration,
    n_found: usize,
    bytes: u64,
}

/// Buffers that a process keeps between queries.
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

fn timing(kind: Kind, limit: usize, runs: Vec<Run>, read_bytes_per_s: f64) -> Timing {
    let mut millis: Vec<f64> = runs.iter().map(|run| run.took.as_secs_f64() * 1e3).collect();
    let mut bytes: Vec<u64> = runs.iter().map(|run| run.bytes).collect();
    let (median_ms, bytes_touched) = (quantile(&mut millis, 500), quantile(&mut bytes, 500));
    let plain_read_ms = bytes_touched as f64 / read_bytes_per_s * 1e3;
    let found = || runs.iter().map(|run| run.n_found);
    Timing {
        kind,
        limit,
        n_runs: runs.len(),
        n_found: [found().min().unwrap_or(0), found().max().unwrap_or(0)],
        median_ms,
        p99_ms: quantile(&mut millis, 990),
        recall: None,
        min_ms: quantile(&mut millis, 0),
        bytes_touched,
        plain_read_ms,
        times_plain_read: median_ms / plain_read_ms,
    }
}

/// Returns the bytes of the shards that an answer reads: all centroids, bases and codewords, and of codes,
/// embeddings and positions those visited.
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
        Positions::Full(_) => 12,
    });
    shards.par_iter().map(of_shard).sum::<u64>()
        + effort.n_blocks_read * block
        + effort.n_fine_read * u64::from(m)
        + effort.n_embeddings_read * u64::from(dim) * size_of::<f16>() as u64
        + found.len() as u64 * position
}
