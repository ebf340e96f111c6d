//! `bench load`: loads a robot's service with more queries than it can answer.

use std::sync::Mutex;
use std::sync::PoisonError;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use clap::Args;
use serde::Serialize;

use crate::harness::{Machine, Times, resident_bytes};
use crate::programs::agent;

/// Time to measure the capacity, and concurrent queries meanwhile.
const WARM_UP: Duration = Duration::from_secs(2);
const WARM_UP_CLIENTS: u32 = 4;
const MAX_BODY_BYTES: u64 = 256 << 20;

/// `bench load`.
#[derive(Debug, Args)]
pub(crate) struct LoadArgs {
    /// Address of the service, as `slag-edge serve` prints it.
    #[arg(long, value_name = "URL")]
    url: String,
    /// Text to look for.
    #[arg(long, default_value = "red")]
    text: String,
    /// The rest of the query string, such as kind=gaussians&format=arrow&limit=100000.
    #[arg(long, value_name = "NAME=VALUE&...", default_value = "limit=10")]
    with: String,
    /// Queries per second, as a multiple of the service's capacity.
    #[arg(long, value_name = "X", default_value_t = 10.0)]
    overload: f64,
    /// Most queries at a time.
    #[arg(long, value_name = "N", default_value_t = 320, value_parser = clap::value_parser!(u32).range(1..=4096))]
    clients: u32,
    /// Duration.
    #[arg(long, value_name = "S", default_value_t = 600)]
    seconds: u64,
    /// Process to sample the memory of (Linux).
    #[arg(long, value_name = "PID")]
    pid: Option<u32>,
}

#[derive(Debug, Serialize)]
pub(crate) struct LoadReport {
    machine: Machine,
    capacity_per_sec: f64,
    offered_per_sec: f64,
    n_clients: u32,
    unloaded: Times,
    accepted: Times,
    /// Refusals (503).
    refused: Times,
    n_without_retry_after: usize,
    n_other_status: usize,
    /// Broken connections and missing answers.
    n_broken: usize,
    body_bytes: usize,
    memory: Option<Memory>,
}

/// Resident memory of the sampled process during the load.
#[derive(Debug, Default, PartialEq, Serialize)]
struct Memory {
    n: usize,
    /// Maximum in the second quarter of the time, when the service has reached its load.
    early_max_bytes: u64,
    /// Maximum in the last quarter.
    late_max_bytes: u64,
}

impl Memory {
    fn of(samples: &[u64]) -> Self {
        let most = |range: std::ops::Range<usize>| samples[range].iter().copied().max().unwrap_or(0);
        let n = samples.len();
        Self { n, early_max_bytes: most(n / 4..n / 2), late_max_bytes: most(n - n.div_ceil(4)..n) }
    }
}

#[derive(Default)]
struct Tally {
    accepted_ms: Vec<f64>,
    refused_ms: Vec<f64>,
    n_sent: usize,
    n_without_retry_after: usize,
    n_other_status: usize,
    n_broken: usize,
    body_bytes: usize,
}

/// Measures the capacity with a few clients, then loads the service beyond it.
pub(crate) fn run(args: &LoadArgs) -> Result<LoadReport> {
    if !(0.01..=1e4).contains(&args.overload) {
        bail!("the overload is {}, expected 0.01 to 10000", args.overload);
    }
    let text: String = args.text.bytes().map(percent_encoded).collect();
    let url = format!("{}/query?text={text}&{}", args.url.trim_end_matches('/'), args.with);
    let warm = load(&url, WARM_UP_CLIENTS, None, WARM_UP);
    if warm.accepted_ms.is_empty() {
        bail!("{url} is not answered with 200; give the address that slag-edge serve prints");
    }
    let capacity_per_sec = warm.accepted_ms.len() as f64 / WARM_UP.as_secs_f64();
    let duration = Duration::from_secs(args.seconds);
    let is_over = AtomicBool::new(false);
    let (tally, samples) = std::thread::scope(|scope| {
        let is_over = &is_over;
        let sampler = args.pid.map(|pid| scope.spawn(move || watch(pid, is_over, duration)));
        let tally = load(&url, args.clients, Some(capacity_per_sec * args.overload), duration);
        is_over.store(true, Ordering::Relaxed);
        (tally, sampler.map(|sampler| sampler.join().unwrap_or_default()))
    });
    Ok(LoadReport {
        machine: Machine::here(),
        capacity_per_sec,
        offered_per_sec: tally.n_sent as f64 / duration.as_secs_f64(),
        n_clients: args.clients,
        unloaded: Times::of(warm.accepted_ms),
        accepted: Times::of(tally.accepted_ms),
        refused: Times::of(tally.refused_ms),
        n_without_retry_after: tally.n_without_retry_after,
        n_other_status: tally.n_other_status,
        n_broken: tally.n_broken,
        body_bytes: tally.body_bytes,
        memory: samples.map(|samples| Memory::of(&samples)),
    })
}

/// Sends queries from `n_clients` threads, at a rate or one after the other.
fn load(url: &str, n_clients: u32, per_sec: Option<f64>, duration: Duration) -> Tally {
    let start = Instant::now();
    let period = per_sec.map_or(Duration::ZERO, |rate| {
        Duration::try_from_secs_f64(f64::from(n_clients) / rate).unwrap_or(Duration::MAX)
    });
    let sum = Mutex::new(Tally::default());
    std::thread::scope(|scope| {
        for client in 0..n_clients {
            let offset = period.mul_f64(f64::from(client) / f64::from(n_clients));
            let sum = &sum;
            scope.spawn(move || {
                let agent = agent();
                let mut next = start + offset;
                loop {
                    std::thread::sleep(next.min(start + duration).saturating_duration_since(Instant::now()));
                    let began = Instant::now();
                    if began >= start + duration {
                        return;
                    }
                    let answer = ask(&agent, url);
                    let ms = began.elapsed().as_secs_f64() * 1e3;
                    sum.lock().unwrap_or_else(PoisonError::into_inner).count(answer, ms);
                    // Missed queries are not made up for: the load never exceeds the rate.
                    next = (next + period).max(Instant::now());
                }
            });
        }
    });
    sum.into_inner().unwrap_or_else(PoisonError::into_inner)
}

/// Returns status, whether there is a Retry-After, and the bytes of the body.
fn ask(agent: &ureq::Agent, url: &str) -> Result<(u16, bool, usize)> {
    let mut reply = agent.get(url).call()?;
    let body = reply.body_mut().with_config().limit(MAX_BODY_BYTES).read_to_vec()?;
    Ok((reply.status().as_u16(), reply.headers().contains_key("retry-after"), body.len()))
}

impl Tally {
    fn count(&mut self, answer: Result<(u16, bool, usize)>, ms: f64) {
        self.n_sent += 1;
        match answer {
            Ok((200, _, len)) => {
                self.accepted_ms.push(ms);
                self.body_bytes = self.body_bytes.max(len);
            }
            Ok((503, has_retry_after, _)) => {
                self.refused_ms.push(ms);
                self.n_without_retry_after += usize::from(!has_retry_after);
            }
            Ok(_) => self.n_other_status += 1,
            Err(_) => self.n_broken += 1,
        }
    }
}

/// Samples a process's resident memory, at least 100 times during the load.
fn watch(pid: u32, is_over: &AtomicBool, duration: Duration) -> Vec<u64> {
    let pause = (duration / 128).min(Duration::from_secs(1));
    let mut samples = Vec::new();
    while !is_over.load(Ordering::Relaxed) {
        samples.extend(resident_bytes(Some(pid)));
        std::thread::sleep(pause);
    }
    samples
}

fn percent_encoded(byte: u8) -> String {
    match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' => char::from(byte).to_string(),
        other => format!("%{other:02X}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_compared_between_quarters() {
        let samples: Vec<u64> = (0..40).map(|i| if i == 3 { 99 } else { i }).collect();
        assert_eq!(Memory::of(&samples), Memory { n: 40, early_max_bytes: 19, late_max_bytes: 39 });
        assert_eq!(Memory::of(&[]), Memory::default());
        assert_eq!(Memory::of(&[5]).late_max_bytes, 5);
        if cfg!(target_os = "linux") {
            assert!(resident_bytes(Some(std::process::id())).is_some_and(|bytes| bytes > 1 << 20));
        }
    }
}
