//! `bench robot`: the paper's table of query times on the robot, with other engines on the same vectors in the
//! same run.
//!
//! A generated field of each size is published, fetched over loopback and queried by the robot's engine. The other
//! engines (`edge/benches/rivals`) get the same vectors and queries. Each has a process of its own, so that the
//! memory of one is not counted for the next. One oracle judges all answers: float64 products of the vectors.

use std::fmt;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};
use clap::Args;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use slag_common::shard::Profile;
use slag_encoder::cli::common::ModelArgs;
use slag_encoder::cli::memory::free_memory_bytes;
use slag_encoder::progress::Progress;

use super::field;
use super::query::{TextArgs, TextReport, time_texts};
use crate::harness::Machine;
use crate::programs::{fetch_all, json_of, remove, sibling};
use crate::table::Table;

#[derive(Debug, Args)]
pub(crate) struct RobotArgs {
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
    /// What to time: profiles of slag-edge, and engines of slag-bench-rivals. NAME=GAUSSIANS leaves an engine out
    /// at larger sizes: a graph of millions takes hours to build.
    #[arg(
        long,
        value_name = "NAME[=MOST],...",
        value_delimiter = ',',
        default_value = "compact,balanced,dense,qdrant-scan,qdrant-scan-int8,qdrant-hnsw,qdrant-hnsw-int8,qdrant-hnsw-pq",
        value_parser = engine
    )]
    engines: Vec<(String, u64)>,
    /// Timed queries of each number of results.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=1000))]
    runs: u32,
    /// The program slag-bench-rivals; without it the other engines are left out.
    #[arg(long, value_name = "FILE")]
    rivals: Option<PathBuf>,
    #[command(flatten)]
    models: ModelArgs,
}

/// An engine's name and the most Gaussians at which it is measured.
fn engine(text: &str) -> Result<(String, u64), String> {
    let (name, most) = text.split_once('=').map_or((text, Ok(u64::MAX)), |(name, most)| (name, most.parse()));
    let is_name =
        !name.is_empty() && name.chars().all(|c| c.is_ascii_lowercase() || c == '-' || c.is_ascii_digit());
    match most {
        Ok(most) if is_name => Ok((name.to_owned(), most)),
        _ => Err(format!("{text:?} is not NAME or NAME=GAUSSIANS, like qdrant-hnsw=1000000")),
    }
}

/// The profile whose shards `slag-edge` queries; `None` for engines of `edge/benches/rivals`.
fn profile_of(engine: &str) -> Option<Profile> {
    Profile::ALL.into_iter().find(|profile| profile.name() == engine)
}

/// The reason not to measure an engine at a size, if there is one; `free`: bytes of memory. Other engines hold all
/// vectors in f32; qdrant-edge holds them twice while it moves them into immutable segments.
fn reason_against(engine: &str, args: &RobotArgs, free: Option<u64>, n_gaussians: u64) -> Option<String> {
    let vectors = n_gaussians * u64::from(args.dim) * 4;
    let needed = match profile_of(engine) {
        None if args.rivals.is_none() => return Some("no --rivals program is given".into()),
        None if engine.starts_with("qdrant") => vectors * 23 / 10,
        None => vectors * 12 / 10,
        Some(_) => n_gaussians * 100,
    };
    let (free, gb) = (free?, |bytes: u64| bytes as f64 / 1e9);
    (needed > free).then(|| format!("needs {:.1} GB of memory, {:.1} are free", gb(needed), gb(free)))
}

#[derive(Debug, Serialize, Deserialize)]
struct Figures {
    engine: String,
    library: String,
    n_gaussians: u64,
    /// Seconds to build the index from vectors; absent for shards, which the encoder makes.
    build_secs: Option<f64>,
    disk_bytes: Option<u64>,
    rss_bytes: Option<u64>,
    searches: Vec<SearchFigures>,
}

/// Times for one number of results, from the query's vector to ids and scores.
#[derive(Debug, Serialize, Deserialize)]
struct SearchFigures {
    limit: u64,
    min_ms: f64,
    median_ms: f64,
    p99_ms: f64,
    /// Share of the true best that is found, mean over the queries; absent where the vectors are not at hand.
    recall: Option<f64>,
}

#[derive(Debug, Serialize)]
pub(crate) struct RobotReport {
    machine: Machine,
    dim: u32,
    sizes: Vec<u64>,
    limits: Vec<u64>,
    text: Option<TextReport>,
    figures: Vec<Figures>,
    pub(crate) not_run: Vec<String>,
}

/// Measures what has no file in `OUT/figures` yet, and writes `robot.json` and `robot.md` for all of it. What was
/// measured before an error is kept.
pub(crate) fn run(args: &RobotArgs, progress: &dyn Progress) -> Result<RobotReport> {
    let texts = TextArgs { models: args.models.clone(), text: vec!["chair".into()], runs: 100 };
    let text = time_texts(&texts);
    let not_run = text.as_ref().err().map(|error| format!("text to vector: {error:#}"));
    let mut report = RobotReport {
        machine: Machine::here(),
        dim: args.dim,
        sizes: args.gaussians.clone(),
        limits: args.limits.clone(),
        text: text.ok(),
        figures: Vec::new(),
        not_run: not_run.into_iter().collect(),
    };
    fs_err::create_dir_all(args.out.join("figures"))?;
    let free = free_memory_bytes();
    for size in &args.gaussians {
        let mut scene = Scene::new(args, *size);
        for (engine, most) in &args.engines {
            let path = args.out.join(format!("figures/{engine}-{size}-{}.json", args.dim));
            if path.is_file() {
                let malformed = || format!("{}: delete the file to measure again", path.display());
                report.figures.push(serde_json::from_slice(&fs_err::read(&path)?).with_context(malformed)?);
            } else if size > most {
                report
                    .not_run
                    .push(format!("{engine} at {} M: asked for up to {most} Gaussians", *size as f64 / 1e6));
            } else if let Some(reason) = reason_against(engine, args, free, *size) {
                report.not_run.push(format!("{engine} at {} M: {reason}", *size as f64 / 1e6));
            } else {
                let figures = scene.measure(engine, progress)?;
                slag_common::durable::write(&path, &serde_json::to_vec_pretty(&figures)?)?;
                report.figures.push(figures);
            }
        }
        remove(&scene.dir)?;
    }
    fs_err::write(args.out.join("robot.json"), serde_json::to_vec_pretty(&report)?)?;
    fs_err::write(args.out.join("robot.md"), report.to_string())?;
    Ok(report)
}

/// A field of one size, made when it is first needed.
struct Scene<'a> {
    args: &'a RobotArgs,
    n_gaussians: u64,
    dir: PathBuf,
    is_published: bool,
    truth: Option<Truth>,
}

impl<'a> Scene<'a> {
    fn new(args: &'a RobotArgs, n_gaussians: u64) -> Self {
        let dir = args.out.join(format!("field-{n_gaussians}"));
        Self { args, n_gaussians, dir, is_published: false, truth: None }
    }

    /// Publishes the field and, for other engines, writes its vectors and queries.
    fn publish(&mut self, progress: &dyn Progress) -> Result<()> {
        let Self { args, n_gaussians, dir, .. } = self;
        if self.is_published {
            return Ok(());
        }
        remove(dir)?;
        let mut profiles: Vec<Profile> =
            args.engines.iter().filter_map(|(engine, _)| profile_of(engine)).collect();
        let has_exact = profiles.contains(&Profile::Exact);
        if args.rivals.is_some() && !has_exact {
            profiles.push(Profile::Exact);
        }
        field::publish(*n_gaussians as usize, args.dim as usize, &dir.join("store"), profiles, progress)?;
        if args.rivals.is_some() {
            let (dump, cache) = (dir.join("dump"), self.fetch(Profile::Exact)?);
            let mut command = Command::new(sibling("slag-lab")?);
            command.args(["--json", "bench", "query", "--runs", "1", "--limits", "1", "--dump"]).arg(&dump);
            json_of(command.arg("--cache").arg(&cache))?;
            if !has_exact {
                remove(&cache)?;
            }
            self.truth = Some(Truth::read(&dump, self.args.dim as usize, self.args.runs as usize)?);
        }
        self.is_published = true;
        Ok(())
    }

    /// Fetches the shards of a profile as a robot does, and returns the cache.
    fn fetch(&self, profile: Profile) -> Result<PathBuf> {
        let cache = self.dir.join(format!("cache-{profile}"));
        if !cache.exists() {
            fetch_all(&self.dir.join("store"), &cache, profile.name())?;
        }
        Ok(cache)
    }

    fn measure(&mut self, engine: &str, progress: &dyn Progress) -> Result<Figures> {
        self.publish(progress)?;
        progress.begin(engine, "engine", 1, 0);
        let (ids, dump) = (self.dir.join("ids"), self.dir.join("dump"));
        fs_err::create_dir_all(&ids)?;
        let limits = self.args.limits.iter().map(u64::to_string).collect::<Vec<_>>().join(",");
        let mut command = match (profile_of(engine), &self.args.rivals) {
            (Some(profile), _) => {
                let mut command = Command::new(sibling("slag-lab")?);
                command.args(["--json", "bench", "query", "--precision", "measured"]);
                command.arg("--cache").arg(self.fetch(profile)?);
                if self.truth.is_some() {
                    command.arg("--queries").arg(dump.join("queries.f32"));
                }
                command
            }
            (None, Some(rivals)) => {
                let mut command = Command::new(rivals);
                command.args(["--engine", engine]).arg("--dump").arg(&dump);
                command
            }
            (None, None) => bail!("{engine}: no --rivals program is given"),
        };
        command.args(["--limits", &limits, "--runs", &self.args.runs.to_string()]).arg("--ids").arg(&ids);
        let printed = json_of(&mut command)?;
        let searches = printed["searches"].as_array().into_iter().flatten();
        let figures = Figures {
            engine: engine.to_owned(),
            library: printed["library"].as_str().unwrap_or("slag-edge").to_owned(),
            n_gaussians: self.n_gaussians,
            build_secs: printed["build_secs"].as_f64(),
            disk_bytes: printed["disk_bytes"].as_u64().or_else(|| printed["shard_bytes"].as_u64()),
            rss_bytes: printed["rss_bytes"].as_u64(),
            searches: searches.map(|of| self.search(of, engine, &ids)).collect::<Result<_>>()?,
        };
        remove(&ids)?;
        progress.end();
        Ok(figures)
    }

    /// Reads times as both programs print them, and judges the ids that they wrote.
    fn search(&self, printed: &Value, name: &str, ids: &Path) -> Result<SearchFigures> {
        // `slag-edge` times two kinds of answers.
        let times = if printed["best"].is_object() { &printed["best"] } else { printed };
        let of = |value: &Value, key: &str| {
            let missing = || format!("{name}: no {key} in its JSON; build it from this version");
            value[key].as_f64().with_context(missing)
        };
        let limit = of(printed, "limit")? as u64;
        Ok(SearchFigures {
            limit,
            min_ms: of(times, "min_ms")?,
            median_ms: of(times, "median_ms")?,
            p99_ms: of(times, "p99_ms")?,
            recall: self
                .truth
                .as_ref()
                .map(|truth| truth.mean_recall(name, limit, ids))
                .transpose()?
                .flatten(),
        })
    }
}

/// The paper's table: Qdrant on a Jetson Orin (Szilagyi et al. 2025), by 1, 2, 4 and 8 million Gaussians.
const PAPER: [(&str, [f64; 4]); 8] = [
    ("1,000 results, s", [0.02, 0.02, 0.02, 0.03]),
    ("10,000", [0.09, 0.11, 0.12, 0.23]),
    ("50,000", [0.43, 0.64, 1.16, 1.32]),
    ("100,000", [0.52, 0.74, 1.36, 2.37]),
    ("PyTorch, dense, s", [0.05, 0.09, 0.17, 0.33]),
    ("Qdrant, RAM, GB", [2.9, 4.9, 9.2, 17.7]),
    ("Qdrant, disk, GB", [0.8, 1.3, 2.3, 4.3]),
    ("PyTorch, RAM, GB", [2.0, 4.0, 8.0, 16.0]),
];

impl fmt::Display for RobotReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "# Queries on the robot: {}\n", self.machine)?;
        writeln!(
            f,
            "`slag-lab bench robot`, {} components; from a text's vector to ids and scores.",
            self.dim
        )?;
        for (model, (text, times)) in self.text.iter().flat_map(|t| t.texts.iter().map(|of| (&t.model, of))) {
            writeln!(f, "Text to vector adds {:.2} ms ({model}, {text:?}).", times.median_ms)?;
        }
        let limits = self.limits.iter().map(|limit| format!("best {limit}"));
        let head = ["engine", "million Gaussians"].map(str::to_owned).into_iter().chain(limits);
        let mut table = Table::new(head.chain(["RAM, GB", "disk, GB", "index, s"].map(str::to_owned)));
        for of in &self.figures {
            let name = format!("{} ({})", of.engine, of.library);
            let mut row = vec![name, (of.n_gaussians as f64 / 1e6).to_string()];
            row.extend(self.limits.iter().map(|limit| {
                let search = of.searches.iter().find(|search| search.limit == *limit);
                search.map_or("-".into(), |search| {
                    let recall = search.recall.map_or("-".into(), |recall| format!("{recall:.3}"));
                    format!("{:.2} ({:.2}, {recall})", search.median_ms, search.min_ms)
                })
            }));
            let gb =
                |bytes: Option<u64>| bytes.map_or("-".into(), |bytes| format!("{:.2}", bytes as f64 / 1e9));
            row.extend([gb(of.rss_bytes), gb(of.disk_bytes)]);
            row.push(of.build_secs.map_or("-".into(), |secs| format!("{secs:.0}")));
            table.row(row);
        }
        writeln!(f, "\nMilliseconds: median (least, recall).\n\n{table}")?;
        self.not_run.iter().try_for_each(|line| writeln!(f, "- not run: {line}"))?;
        let mut paper = Table::new(["the paper: Qdrant on a Jetson Orin", "1 M", "2 M", "4 M", "8 M"]);
        for (name, row) in PAPER {
            paper.row(std::iter::once(name.to_owned()).chain(row.map(|v| v.to_string())));
        }
        writeln!(f, "\n{paper}\nText encoding adds 0.20 to 0.25 s there (Szilagyi et al. 2025).")
    }
}

const BLOCK: usize = 1 << 14;
/// Scores this close to the last of the best count as ties: the products of others are of f32.
const TIE: f64 = 1e-6;

pub(super) struct Truth {
    /// `[n_queries][n]`.
    scores: Vec<Vec<f64>>,
}

impl Truth {
    /// Reads `vectors.f32` and the first `n_queries` of `queries.f32`, `[n][dim]` each and little-endian.
    pub(super) fn read(dump: &Path, dim: usize, n_queries: usize) -> std::io::Result<Self> {
        let floats = |bytes: &[u8]| -> Vec<f64> {
            bytes.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]]))).collect()
        };
        let queries = floats(&fs_err::read(dump.join("queries.f32"))?);
        let queries: Vec<&[f64]> = queries.chunks_exact(dim).take(n_queries).collect();
        let mut file = File::open(dump.join("vectors.f32"))?;
        let mut scores = vec![Vec::new(); queries.len()];
        loop {
            let mut bytes = Vec::with_capacity(BLOCK * dim * 4);
            file.by_ref().take((BLOCK * dim * 4) as u64).read_to_end(&mut bytes)?;
            if bytes.is_empty() {
                return Ok(Self { scores });
            }
            let block: Vec<f64> = floats(&bytes);
            scores.par_iter_mut().zip(&queries).for_each(|(scores, query)| {
                scores.extend(block.chunks_exact(dim).map(|vector| slag_math::dot_f64(vector, query)));
            });
        }
    }

    /// Returns the mean recall of the queries whose ids were written, as `NAME-LIMIT-QUERY.u32`.
    pub(super) fn mean_recall(&self, name: &str, limit: u64, ids: &Path) -> std::io::Result<Option<f64>> {
        let mut recalls = Vec::new();
        for query in 0..self.scores.len() {
            let path = ids.join(format!("{name}-{limit}-{query}.u32"));
            if path.is_file() {
                let bytes = fs_err::read(path)?;
                let found = bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
                recalls.extend(self.recall(query, limit as usize, found.collect()));
            }
        }
        Ok((!recalls.is_empty()).then(|| recalls.iter().sum::<f64>() / recalls.len() as f64))
    }

    /// Share found of a query's best `limit` vectors; `None` for a query without scores.
    fn recall(&self, query: usize, limit: usize, mut found: Vec<u32>) -> Option<f64> {
        let scores = self.scores.get(query).filter(|scores| !scores.is_empty())?;
        let limit = limit.min(scores.len());
        let mut sorted = scores.clone();
        let (_, last, _) = sorted.select_nth_unstable_by(limit.checked_sub(1)?, |a, b| b.total_cmp(a));
        let reached = *last - TIE;
        found.sort_unstable();
        found.dedup();
        let is_best = |id: &&u32| scores.get(**id as usize).is_some_and(|score| *score >= reached);
        Some(found.iter().filter(is_best).count().min(limit) as f64 / limit as f64)
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        args: RobotArgs,
    }

    /// A second run measures nothing again; an engine without its program or memory is named.
    #[test]
    fn what_cannot_run_is_named() {
        let dir = tempfile::tempdir().expect("a folder");
        let out = dir.path().to_str().expect("UTF-8");
        let line = ["x", "--out", out, "--gaussians", "1000,2000", "--limits", "10", "--dim", "16"];
        let line = line.into_iter().chain(["--engines", "dense,qdrant-scan=1000", "--models", "colours"]);
        let args = Line::parse_from(line).args;
        let few = RobotArgs { rivals: Some(PathBuf::new()), ..Line::parse_from(["x", "--out", out]).args };
        assert!(reason_against("dense", &few, Some(10), 1000).is_some_and(|reason| reason.contains("needs")));
        let kept = r#"{"engine":"dense","library":"l","n_gaussians":1000,"build_secs":61.0,"disk_bytes":52000000,
            "rss_bytes":null,"searches":[{"limit":10,"min_ms":0.5,"median_ms":12.3,"p99_ms":20,"recall":0.9}]}"#;
        fs_err::create_dir_all(dir.path().join("figures")).expect("makes");
        fs_err::write(dir.path().join("figures/dense-1000-16.json"), kept).expect("writes");
        let report = run(&args, &slag_encoder::progress::Silent).expect("runs");
        let page = fs_err::read_to_string(dir.path().join("robot.md")).expect("a page");
        let lines: Vec<String> =
            page.lines().map(|l| l.split_whitespace().collect::<Vec<_>>().join(" ")).collect();
        for line in [
            "| dense (l) | 0.001 | 12.30 (0.50, 0.900) | - | 0.05 | 61 |",
            "- not run: dense at 0.002 M: no --rivals program is given",
            "- not run: qdrant-scan at 0.002 M: asked for up to 1000 Gaussians",
            "| 100,000 | 0.52 | 0.74 | 1.36 | 2.37 |",
        ] {
            assert!(lines.iter().any(|found| found == line), "{line}\n{page}");
        }
        // The model of colours knows no chair.
        assert!(report.not_run[0].starts_with("text to vector: "), "{:?}", report.not_run);
        assert!(report.figures.len() == 1 && report.text.is_none());
    }

    /// By hand: scores 1, 0.5, 0.5, 0 and -1; the second and third are ties.
    #[test]
    fn recall_counts_ties_and_each_id_once() {
        let dir = tempfile::tempdir().expect("a folder");
        let write = |name: &str, values: &[f32]| {
            let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            fs_err::write(dir.path().join(name), bytes).expect("writes");
        };
        write("vectors.f32", &[0.5, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.5, 0.8]);
        write("queries.f32", &[1.0, 0.0, 0.0, 1.0]);
        let truth = Truth::read(dir.path(), 2, 1).expect("reads");
        for (limit, found, expected) in [
            (1, vec![2], 1.0),
            (2, vec![2, 4], 1.0),
            (2, vec![2, 0], 1.0),
            (3, vec![2, 4, 3], 2.0 / 3.0),
            (3, vec![2, 2, 2], 1.0 / 3.0),
            (9, vec![0, 1, 2, 3, 4], 1.0),
            (2, vec![77], 0.0),
        ] {
            assert_eq!(truth.recall(0, limit, found.clone()), Some(expected), "{limit} {found:?}");
        }
        assert_eq!(truth.recall(1, 2, vec![0]), None, "one query was read");
    }
}
