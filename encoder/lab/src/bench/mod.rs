//! Benchmarks as commands: each writes JSON that names the machine, and compares side by side in one
//! run.

pub mod arrays;
pub mod codec;
pub mod field;
pub mod lift;
pub mod plot;
pub mod raster;
pub mod scene;
pub mod tradeoff;

use std::time::Instant;

use serde::Serialize;

/// Where figures were measured.
#[derive(Clone, Debug, Serialize)]
pub struct Machine {
    /// Processor, as the system names it.
    pub cpu: String,
    /// Threads of the pool that the work runs on.
    pub n_threads: usize,
    /// Operating system and architecture.
    pub platform: String,
    /// Version of this program.
    pub version: &'static str,
}

impl Machine {
    /// Looks at the machine this runs on.
    pub fn here() -> Self {
        let info = fs_err::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let name = info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
        Self {
            cpu: name.map_or_else(|| "unknown".into(), |(_, name)| name.to_owned()),
            n_threads: rayon::current_num_threads(),
            platform: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            version: env!("CARGO_PKG_VERSION"),
        }
    }
}

/// Several timings of the same work.
#[derive(Clone, Debug, Serialize)]
pub struct Spread {
    /// Number of timings.
    pub n: usize,
    /// Fastest, milliseconds.
    pub min_ms: f64,
    /// 10th percentile, milliseconds.
    pub p10_ms: f64,
    /// Median, milliseconds.
    pub median_ms: f64,
    /// 90th percentile, milliseconds.
    pub p90_ms: f64,
    /// Slowest, milliseconds.
    pub max_ms: f64,
}

impl Spread {
    /// Sums timings up; there must be one.
    pub fn of(mut timings_ms: Vec<f64>) -> Self {
        timings_ms.sort_by(f64::total_cmp);
        let n = timings_ms.len();
        let at = |share: f64| timings_ms[((n - 1) as f64 * share).round() as usize];
        Self { n, min_ms: at(0.0), p10_ms: at(0.1), median_ms: at(0.5), p90_ms: at(0.9), max_ms: at(1.0) }
    }
}

/// Returns what a piece of work gives, and the milliseconds it took.
pub fn timed_ms<T>(work: impl FnOnce() -> T) -> (T, f64) {
    let start = Instant::now();
    let result = work();
    (result, start.elapsed().as_secs_f64() * 1e3)
}
