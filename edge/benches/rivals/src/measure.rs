//! Builds an index and times its searches.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde::Serialize;

use crate::dense::Dense;
use crate::dump::{Dump, Meta};
use crate::qdrant::Qdrant;
use crate::{Args, Engine, Index};

#[derive(Debug, Serialize)]
pub struct Report {
    engine: Engine,
    library: String,
    meta: Meta,
    cpu: String,
    n_threads_available: usize,
    build_secs: f64,
    /// Of the index; absent if there is none.
    disk_bytes: Option<u64>,
    /// Resident memory after the searches, without the dump's vectors (Linux).
    rss_bytes: Option<u64>,
    searches: Vec<Search>,
}

/// Times of the searches for one number of results.
#[derive(Debug, Serialize)]
struct Search {
    limit: usize,
    n_runs: usize,
    /// Fewest results of a search; a graph may return fewer than were asked for.
    n_found_least: usize,
    min_ms: f64,
    median_ms: f64,
    p99_ms: f64,
    max_ms: f64,
}

pub fn run(args: &Args, dump: Dump) -> Result<Report> {
    let meta = dump.meta;
    let work = args.work.clone().unwrap_or_else(|| args.dump.join(args.engine.name()));
    std::fs::create_dir(&work)
        .with_context(|| format!("{}: the index needs a new folder", work.display()))?;
    let measured = (|| {
        let started = Instant::now();
        let index: Box<dyn Index> = match args.engine {
            Engine::Dense => Box::new(Dense::new(&dump)),
            _ => Box::new(Qdrant::build(&dump, &work, args.engine)?),
        };
        let build_secs = started.elapsed().as_secs_f64();
        let queries = dump.into_queries();
        let searches =
            args.limits.iter().map(|limit| time(args, &*index, &queries, *limit)).collect::<Result<_>>()?;
        Ok(Report {
            engine: args.engine,
            library: args.engine.library(),
            meta,
            cpu: proc_line("/proc/cpuinfo", "model name").unwrap_or_else(|| std::env::consts::ARCH.into()),
            n_threads_available: std::thread::available_parallelism().map_or(0, Into::into),
            build_secs,
            disk_bytes: Some(disk_bytes(&work)?).filter(|_| args.engine != Engine::Dense),
            rss_bytes: rss_bytes(),
            searches,
        })
    })();
    std::fs::remove_dir_all(&work)?;
    measured
}

fn time(args: &Args, index: &dyn Index, queries: &[Vec<f32>], limit: usize) -> Result<Search> {
    let of_run = |run: usize| run % queries.len();
    for run in 0..args.warm_up {
        index.search(&queries[of_run(run)], limit)?;
    }
    let mut times: Vec<Duration> = Vec::new();
    let mut n_found_least = usize::MAX;
    for run in 0..args.runs {
        let started = Instant::now();
        let found = index.search(&queries[of_run(run)], limit)?;
        times.push(started.elapsed());
        n_found_least = n_found_least.min(found.len());
        if let Some(dir) = args.ids.as_ref().filter(|_| run < queries.len()) {
            std::fs::create_dir_all(dir)?;
            let name = format!("{}-{limit}-{run}.u32", args.engine.name());
            std::fs::write(dir.join(name), bytemuck::cast_slice::<u32, u8>(&found))?;
        }
    }
    times.sort_unstable();
    let ms = |rank: usize| times[rank].as_secs_f64() * 1e3;
    Ok(Search {
        limit,
        n_runs: times.len(),
        n_found_least,
        min_ms: ms(0),
        median_ms: ms(times.len() / 2),
        p99_ms: ms((times.len() * 99).div_ceil(100) - 1),
        max_ms: ms(times.len() - 1),
    })
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
