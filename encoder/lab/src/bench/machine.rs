//! The machine of a benchmark.

use serde::Serialize;

/// The machine of a benchmark.
#[derive(Clone, Debug, Serialize)]
pub struct Machine {
    /// Processor, as the system names it.
    pub cpu: String,
    /// Threads of the pool.
    pub n_threads: usize,
    /// Operating system and architecture.
    pub platform: String,
    /// Version of this program.
    pub version: &'static str,
    /// How it was compiled.
    pub build: &'static str,
}

impl Machine {
    /// Describes this machine.
    pub fn here() -> Self {
        let info = fs_err::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let name = info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
        // Arm boards have no such line, but name themselves.
        let board = || fs_err::read_to_string("/proc/device-tree/model").ok();
        let board = || board().map(|name| name.trim_end_matches('\0').to_owned());
        Self {
            cpu: name.map(|(_, name)| name.to_owned()).or_else(board).unwrap_or_else(|| "unknown".into()),
            n_threads: rayon::current_num_threads(),
            platform: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            version: env!("CARGO_PKG_VERSION"),
            build: if cfg!(debug_assertions) {
                "build with checks, as tests have"
            } else {
                "optimised build"
            },
        }
    }
}
