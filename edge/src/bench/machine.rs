//! The machine of a measurement, as reported by Linux; fields are absent without `/proc`.

use std::time::Instant;

use rayon::prelude::*;
use serde::Serialize;
use slag_math::simd::InstructionSet;

/// Larger than processor caches.
const READ_BYTES: usize = 256 << 20;
/// Bytes that one task of the plain loop reads.
const READ_CHUNK: usize = 1 << 20;

/// The machine of a measurement.
#[derive(Clone, Debug, Serialize)]
pub struct Machine {
    /// The processor's name.
    pub cpu: String,
    /// Its architecture.
    pub arch: &'static str,
    /// Cores that the process may use.
    pub n_cores: usize,
    /// Threads for answering questions.
    pub n_threads: usize,
    /// Instruction set used for centroids and codes.
    pub simd: &'static str,
    /// Whether the program was compiled with overflow checks, as tests are.
    pub is_debug_build: bool,
}

impl Machine {
    /// Describes this machine.
    pub fn here() -> Self {
        let info = fs_err::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let cpu = field(&info, "model name").unwrap_or("unknown").to_owned();
        Self {
            cpu,
            arch: std::env::consts::ARCH,
            n_cores: std::thread::available_parallelism().map_or(1, usize::from),
            n_threads: rayon::current_num_threads(),
            simd: InstructionSet::widest().name(),
            is_debug_build: cfg!(debug_assertions),
        }
    }
}

/// Memory of this process.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Memory {
    /// Resident now, including pages of mapped shards.
    pub rss_bytes: Option<u64>,
    /// Anonymous part of it.
    pub anonymous_bytes: Option<u64>,
    /// Peak resident memory.
    pub peak_rss_bytes: Option<u64>,
}

impl Memory {
    /// Returns the memory in use now.
    pub fn now() -> Self {
        let status = fs_err::read_to_string("/proc/self/status").unwrap_or_default();
        let bytes = |key: &str| Some(field(&status, key)?.strip_suffix(" kB")?.parse::<u64>().ok()? << 10);
        Self { rss_bytes: bytes("VmRSS"), anonymous_bytes: bytes("RssAnon"), peak_rss_bytes: bytes("VmHWM") }
    }
}

/// Returns the value of a `key: value` line.
fn field<'a>(lines: &'a str, key: &str) -> Option<&'a str> {
    let mut fields = lines.lines().filter_map(|line| line.split_once(':'));
    fields.find(|(found, _)| found.trim() == key).map(|(_, value)| value.trim())
}

/// Measures the bytes per second of a plain loop over memory on all threads: the best of several passes.
pub fn read_bandwidth() -> f64 {
    let memory: Vec<u64> = vec![1; READ_BYTES / 8];
    let pass = |_| {
        let start = Instant::now();
        let sum = |chunk: &[u64]| chunk.iter().fold(0u64, |sum, v| sum.wrapping_add(*v));
        let total: u64 = memory.par_chunks(READ_CHUNK / 8).map(sum).sum();
        std::hint::black_box(total);
        READ_BYTES as f64 / start.elapsed().as_secs_f64()
    };
    (0..8).map(pass).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_found() {
        let text = "VmPeak:\t 12 kB\nVmRSS:\t  345 kB\nmodel name\t: A: B\n";
        assert_eq!((field(text, "VmRSS"), field(text, "model name")), (Some("345 kB"), Some("A: B")));
        assert_eq!(field(text, "Vm"), None);
        let memory = Memory::now();
        assert!(memory.rss_bytes > Some(1 << 20) && memory.peak_rss_bytes >= memory.rss_bytes);
    }
}
