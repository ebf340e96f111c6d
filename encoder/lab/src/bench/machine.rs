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
}

impl Machine {
    /// Describes this machine.
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
