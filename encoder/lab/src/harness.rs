//! What all benchmarks share: repetition, percentiles, and the machine that they name.

use std::time::Instant;

use serde::Serialize;
use slag_math::simd::InstructionSet;
use slag_math::stats::{Rank, quantile};

/// The machine of a benchmark, as Linux names it.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Machine {
    pub(crate) cpu: String,
    pub(crate) n_threads: usize,
    platform: String,
    simd: &'static str,
    version: &'static str,
    is_debug_build: bool,
    /// Load average of the last minute, this program's own work included.
    load_1min: Option<f64>,
}

impl Machine {
    pub(crate) fn here() -> Self {
        let info = fs_err::read_to_string("/proc/cpuinfo").unwrap_or_default();
        // Arm boards have no model name in /proc/cpuinfo.
        let board = || fs_err::read_to_string("/proc/device-tree/model").ok();
        let board = || board().map(|name| name.trim_end_matches('\0').to_owned());
        Self {
            cpu: field(&info, "model name").or_else(board).unwrap_or_else(|| "unknown".into()),
            n_threads: rayon::current_num_threads(),
            platform: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            simd: InstructionSet::widest().name(),
            version: env!("CARGO_PKG_VERSION"),
            is_debug_build: cfg!(debug_assertions),
            load_1min: load_1min(),
        }
    }
}

impl std::fmt::Display for Machine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { cpu, n_threads, platform, simd, version, is_debug_build, .. } = self;
        let build = if *is_debug_build { "build with checks, as tests have" } else { "optimised build" };
        write!(f, "{cpu}, {n_threads} threads, {simd}, {platform}; slag {version}, {build}")
    }
}

fn field(lines: &str, key: &str) -> Option<String> {
    let mut fields = lines.lines().filter_map(|line| line.split_once(':'));
    fields.find(|(found, _)| found.trim() == key).map(|(_, value)| value.trim().to_owned())
}

/// Linux only.
pub(crate) fn load_1min() -> Option<f64> {
    fs_err::read_to_string("/proc/loadavg").ok()?.split(' ').next()?.parse().ok()
}

/// Linux only.
pub(crate) fn resident_bytes() -> Option<u64> {
    let status = fs_err::read_to_string("/proc/self/status").ok()?;
    Some(field(&status, "VmRSS")?.strip_suffix(" kB")?.parse::<u64>().ok()? << 10)
}

#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(crate) struct Times {
    pub(crate) n: usize,
    pub(crate) min_ms: f64,
    pub(crate) median_ms: f64,
    pub(crate) p90_ms: f64,
    pub(crate) p99_ms: f64,
    pub(crate) max_ms: f64,
}

impl Times {
    /// Summarises times; zeros without any.
    pub(crate) fn of(mut times_ms: Vec<f64>) -> Self {
        let n = times_ms.len();
        let mut at = |per_mille| quantile(&mut times_ms, per_mille, Rank::Nearest).unwrap_or_default();
        Self { n, min_ms: at(0), median_ms: at(500), p90_ms: at(900), p99_ms: at(990), max_ms: at(1000) }
    }

    /// Runs work `n_warm_up` times untimed and `n` times timed; the work is told its turn.
    pub(crate) fn measure<E>(
        n_warm_up: usize,
        n: usize,
        mut work: impl FnMut(usize) -> Result<(), E>,
    ) -> Result<Self, E> {
        let mut times_ms = Vec::with_capacity(n);
        for turn in 0..n_warm_up + n {
            let (done, ms) = timed_ms(|| work(turn));
            done?;
            times_ms.push(ms);
        }
        Ok(Self::of(times_ms.split_off(n_warm_up)))
    }
}

/// Returns the result and the duration in milliseconds.
pub(crate) fn timed_ms<T>(work: impl FnOnce() -> T) -> (T, f64) {
    let start = Instant::now();
    let result = work();
    (result, start.elapsed().as_secs_f64() * 1e3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_found_and_warm_up_does_not_count() {
        let text = "VmPeak:\t 12 kB\nVmRSS:\t  345 kB\nmodel name\t: A: B\n";
        let found = (field(text, "VmRSS"), field(text, "model name"));
        assert_eq!(found, (Some("345 kB".into()), Some("A: B".into())));
        assert_eq!(field(text, "Vm"), None);
        let mut turns = Vec::new();
        let work = |turn| {
            turns.push(turn);
            Ok::<(), ()>(())
        };
        let times = Times::measure(2, 3, work).expect("does not fail");
        assert_eq!((times.n, turns), (3, vec![0, 1, 2, 3, 4]));
        let times = Times::of((1..=100).map(f64::from).collect());
        assert_eq!((times.min_ms, times.median_ms, times.p99_ms, times.max_ms), (1.0, 50.0, 99.0, 100.0));
    }
}
