//! Times qdrant-edge on vectors and queries that `slag-edge bench query --dump DIR` wrote.
//!
//! `DIR` holds little-endian `vectors.f32` `[n][dim]`, `queries.f32` `[n_queries][dim]` and `meta.json`,
//! `{"n":…,"dim":…,"n_queries":…}`; vectors are of unit length. Both runs scan all vectors (no HNSW graph):
//! `exact` compares f32, `int8` compares scalar-quantised vectors and does not rescore.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use clap::{Parser, ValueEnum};
use qdrant_edge::{
    Distance, EdgeConfig, EdgeConfigBuilder, EdgeShard, EdgeVectorParamsBuilder, HnswIndexConfig, NamedQuery,
    PointId, PointInsertOperations, PointOperations, PointStruct, QuantizationConfig,
    QuantizationSearchParams, QueryEnum, ScalarQuantizationConfig, ScalarType, SearchParams, SearchRequest,
    UpdateOperation, VectorInternal,
};
use serde::{Deserialize, Serialize};

/// Points in one insert: 16 MB of vectors at 512 components.
const INSERT: usize = 8192;

/// Times qdrant-edge on a dump of vectors and queries.
#[derive(Debug, Parser)]
struct Args {
    /// Folder with vectors.f32, queries.f32 and meta.json.
    #[arg(long, value_name = "DIR")]
    dump: PathBuf,
    /// Folder for the database; created, and removed at the end [default: qdrant-MODE in the dump].
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Modes to time.
    #[arg(long, value_enum, default_values_t = [Mode::Exact, Mode::Int8])]
    mode: Vec<Mode>,
    /// Numbers of results.
    #[arg(long, value_delimiter = ',', default_values_t = [1_000, 10_000, 50_000, 100_000])]
    limit: Vec<usize>,
    /// Least timed searches per limit; queries take turns.
    #[arg(long, default_value_t = 10)]
    runs: usize,
    /// Untimed searches before them.
    #[arg(long, default_value_t = 2)]
    warm_up: usize,
    /// File for the JSON [default: standard output].
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Folder for the ids that each search found, as little-endian u32, best first: MODE-LIMIT-QUERY.u32.
    #[arg(long, value_name = "DIR")]
    ids: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
enum Mode {
    Exact,
    Int8,
}

impl Mode {
    fn name(self) -> &'static str {
        match self {
            Self::Exact => "exact",
            Self::Int8 => "int8",
        }
    }
}

#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct Meta {
    n: usize,
    dim: usize,
    n_queries: usize,
}

#[derive(Debug, Serialize)]
struct Report {
    engine: &'static str,
    meta: Meta,
    cpu: String,
    n_threads_available: usize,
    modes: Vec<ModeReport>,
}

#[derive(Debug, Serialize)]
struct ModeReport {
    mode: Mode,
    build_secs: f64,
    disk_bytes: u64,
    /// Resident memory after the searches.
    rss_bytes: Option<u64>,
    searches: Vec<SearchReport>,
}

#[derive(Debug, Serialize)]
struct SearchReport {
    limit: usize,
    n_runs: usize,
    median_ms: f64,
    p99_ms: f64,
    min_ms: f64,
    max_ms: f64,
    /// Share of the true best results that each query found, by the dump's vectors in f64 and with ties; the
    /// mean.
    recall: f64,
}

struct Dump {
    meta: Meta,
    vectors: Vec<f32>,
    queries: Vec<f32>,
}

impl Dump {
    fn read(dir: &Path) -> Result<Self> {
        let read = |name: &str| {
            let path = dir.join(name);
            std::fs::read(&path).with_context(|| format!("{} cannot be read", path.display()))
        };
        let meta: Meta = serde_json::from_slice(&read("meta.json")?).context("meta.json")?;
        ensure!(meta.n > 0 && meta.dim > 0 && meta.n_queries > 0, "meta.json: nothing to compare: {meta:?}");
        let floats = |name: &str, n: usize| -> Result<Vec<f32>> {
            let bytes = read(name)?;
            let expected = n.checked_mul(meta.dim).and_then(|n| n.checked_mul(4));
            ensure!(
                Some(bytes.len()) == expected,
                "{name} has {} bytes, meta.json says [{n}][{}]",
                bytes.len(),
                meta.dim
            );
            Ok(bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
        };
        Ok(Self {
            meta,
            vectors: floats("vectors.f32", meta.n)?,
            queries: floats("queries.f32", meta.n_queries)?,
        })
    }

    fn query(&self, query: usize) -> &[f32] {
        &self.queries[query * self.meta.dim..][..self.meta.dim]
    }

    /// Returns every vector's product with a query, in f64.
    fn scores(&self, query: usize) -> Vec<f64> {
        let query = self.query(query);
        let dot = |v: &[f32]| v.iter().zip(query).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
        self.vectors.chunks_exact(self.meta.dim).map(dot).collect()
    }
}

fn main() -> Result<()> {
    let args = Args::parse();
    ensure!(
        args.runs >= 10,
        "--runs is {}, at least 10 are needed for a 99th percentile to mean anything",
        args.runs
    );
    let dump = Dump::read(&args.dump)?;
    if let Some(dir) = &args.ids {
        std::fs::create_dir_all(dir)?;
    }
    let truth: Vec<Vec<f64>> = (0..dump.meta.n_queries).map(|query| dump.scores(query)).collect();
    let modes = args.mode.iter().map(|mode| time(&args, &dump, &truth, *mode)).collect::<Result<_>>()?;
    let report = Report {
        engine: "qdrant-edge 0.7.2",
        meta: dump.meta,
        cpu: cpu_name(),
        n_threads_available: std::thread::available_parallelism().map_or(0, Into::into),
        modes,
    };
    let text = serde_json::to_string_pretty(&report)?;
    match &args.json {
        Some(path) => std::fs::write(path, text)?,
        None => println!("{text}"),
    }
    Ok(())
}

/// Without edges there is no graph: every search scans.
fn config(dim: usize, mode: Mode) -> EdgeConfig {
    let no_graph = HnswIndexConfig {
        m: 0,
        ef_construct: 4,
        full_scan_threshold: usize::MAX / 1024,
        max_indexing_threads: 0,
        on_disk: Some(false),
        payload_m: Some(0),
        inline_storage: None,
    };
    let int8 =
        ScalarQuantizationConfig { r#type: ScalarType::Int8, quantile: Some(0.99), always_ram: Some(true) };
    // Unit vectors: the dot product is the cosine, and normalising again is unnecessary.
    let mut vector =
        EdgeVectorParamsBuilder::new(dim, Distance::Dot).hnsw_config(no_graph.clone()).on_disk(false);
    if mode == Mode::Int8 {
        vector = vector.quantization_config(QuantizationConfig::from(int8));
    }
    EdgeConfigBuilder::new()
        .vector(qdrant_edge::DEFAULT_VECTOR_NAME, vector.build())
        .hnsw_config(no_graph)
        .build()
}

fn build(dump: &Dump, work: &Path, mode: Mode) -> Result<EdgeShard> {
    let shard = EdgeShard::new(work, config(dump.meta.dim, mode))?;
    for (at, block) in dump.vectors.chunks(INSERT * dump.meta.dim).enumerate() {
        let points = block.chunks_exact(dump.meta.dim).enumerate().map(|(i, vector)| {
            let id = PointId::NumId((at * INSERT + i) as u64);
            PointStruct::new(id, vector.to_vec(), serde_json::json!({})).into()
        });
        let points = PointInsertOperations::PointsList(points.collect());
        shard.update(UpdateOperation::PointOperation(PointOperations::UpsertPoints(points)))?;
    }
    // Moves the points into immutable segments, quantised if the mode asks for it.
    shard.optimize()?;
    shard.flush();
    Ok(shard)
}

fn search(shard: &EdgeShard, query: &[f32], limit: usize, mode: Mode) -> Result<Vec<u32>> {
    let quantization =
        QuantizationSearchParams { ignore: mode == Mode::Exact, rescore: Some(false), oversampling: None };
    let found = shard.search(SearchRequest {
        query: QueryEnum::Nearest(NamedQuery { query: VectorInternal::Dense(query.to_vec()), using: None }),
        filter: None,
        params: Some(SearchParams {
            exact: mode == Mode::Exact,
            quantization: Some(quantization),
            ..SearchParams::default()
        }),
        limit,
        offset: 0,
        with_payload: None,
        with_vector: None,
        score_threshold: None,
    })?;
    let id = |id: &PointId| match id {
        PointId::NumId(id) => Ok(u32::try_from(*id)?),
        PointId::Uuid(_) => bail!("a point has an id that was never given"),
    };
    found.iter().map(|point| id(&point.id)).collect()
}

fn time(args: &Args, dump: &Dump, truth: &[Vec<f64>], mode: Mode) -> Result<ModeReport> {
    let work = args.work.clone().unwrap_or_else(|| args.dump.join(format!("qdrant-{}", mode.name())));
    std::fs::create_dir(&work)
        .with_context(|| format!("{}: the database needs a new folder", work.display()))?;
    let started = Instant::now();
    let shard = build(dump, &work, mode)?;
    let build_secs = started.elapsed().as_secs_f64();
    let mut searches = Vec::new();
    for limit in args.limit.iter().copied() {
        let n_queries = dump.meta.n_queries;
        for run in 0..args.warm_up {
            search(&shard, dump.query(run % n_queries), limit, mode)?;
        }
        let mut times = Vec::new();
        let mut recalls = Vec::new();
        for run in 0..args.runs.max(n_queries) {
            let query = run % n_queries;
            let started = Instant::now();
            let found = search(&shard, dump.query(query), limit, mode)?;
            times.push(started.elapsed());
            if run < n_queries {
                recalls.push(recall(&found, &truth[query], limit));
                if let Some(dir) = &args.ids {
                    let bytes: Vec<u8> = found.iter().flat_map(|id| id.to_le_bytes()).collect();
                    std::fs::write(dir.join(format!("{}-{limit}-{query}.u32", mode.name())), bytes)?;
                }
            }
        }
        times.sort_unstable();
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        searches.push(SearchReport {
            limit,
            n_runs: times.len(),
            median_ms: ms(times[times.len() / 2]),
            p99_ms: ms(times[(times.len() * 99).div_ceil(100) - 1]),
            min_ms: ms(times[0]),
            max_ms: ms(times[times.len() - 1]),
            recall: recalls.iter().sum::<f64>() / recalls.len() as f64,
        });
    }
    let rss_bytes = rss_bytes();
    let disk_bytes = disk_bytes(&work)?;
    drop(shard);
    std::fs::remove_dir_all(&work)?;
    Ok(ModeReport { mode, build_secs, disk_bytes, rss_bytes, searches })
}

/// Returns the share of the best `limit` that was found; ties with the last of them count.
fn recall(found: &[u32], scores: &[f64], limit: usize) -> f64 {
    let limit = limit.min(scores.len());
    let mut sorted = scores.to_vec();
    let (_, last, _) = sorted.select_nth_unstable_by(limit - 1, |a, b| b.total_cmp(a));
    let reached = *last - 1e-6;
    let n =
        found.iter().filter(|id| scores.get(**id as usize).is_some_and(|score| *score >= reached)).count();
    n.min(limit) as f64 / limit as f64
}

fn disk_bytes(dir: &Path) -> Result<u64> {
    let mut bytes = 0;
    for entry in std::fs::read_dir(dir)? {
        let (path, meta) = entry.and_then(|entry| Ok((entry.path(), entry.metadata()?)))?;
        bytes += if meta.is_dir() { disk_bytes(&path)? } else { meta.len() };
    }
    Ok(bytes)
}

fn proc_line(path: &str, name: &str) -> Option<String> {
    let text = std::fs::read_to_string(path).ok()?;
    let line = text.lines().find(|line| line.starts_with(name))?;
    Some(line.split_once(':')?.1.trim().to_owned())
}

fn rss_bytes() -> Option<u64> {
    let kib: u64 = proc_line("/proc/self/status", "VmRSS")?.split(' ').next()?.parse().ok()?;
    Some(kib * 1024)
}

fn cpu_name() -> String {
    proc_line("/proc/cpuinfo", "model name").unwrap_or_else(|| std::env::consts::ARCH.to_owned())
}
