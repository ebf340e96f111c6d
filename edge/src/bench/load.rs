//! How a service stands more queries than it can answer: an HTTP client of its own, paced.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde::Serialize;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::TcpStream;
use tokio::time::Instant;

use super::machine::Machine;
use super::times::{Percentiles, Times};

/// A longer answer than any of ours.
const MAX_BODY_BYTES: u64 = 64 << 20;
const MAX_LINE_BYTES: u64 = 16 << 10;
/// Patience with one answer.
const PATIENCE: Duration = Duration::from_secs(30);
/// Questions at a time while the capacity is measured.
const CAPACITY_CLIENTS: usize = 4;

/// What is asked.
#[derive(Clone, Debug)]
pub struct LoadOptions {
    /// `IP:PORT` of the service.
    pub address: String,
    /// The path asked for, percent-encoded.
    pub path: String,
    /// Questions at a time.
    pub n_clients: usize,
    /// Questions offered a second, as a multiple of what the service answers.
    pub overload: f64,
    /// Time to measure what the service answers.
    pub warm_up: Duration,
    /// Time of the load.
    pub duration: Duration,
    /// Process whose memory is watched.
    pub pid: Option<u32>,
}

/// How it went.
#[derive(Clone, Debug, Serialize)]
pub struct LoadReport {
    /// Where.
    pub machine: Machine,
    /// Answers a second without overload.
    pub capacity_per_sec: f64,
    /// Questions sent a second under load.
    pub offered_per_sec: f64,
    /// Questions at a time, at most.
    pub n_clients: usize,
    /// Seconds of load.
    pub seconds: f64,
    /// Times without overload.
    pub unloaded: Percentiles,
    /// Times of the answers under load.
    pub accepted: Percentiles,
    /// Times of the refusals (503).
    pub refused: Percentiles,
    /// Refusals without `Retry-After`.
    pub n_without_retry_after: u64,
    /// Any other status.
    pub n_other_status: u64,
    /// Connections that broke or answers that did not come.
    pub n_broken: u64,
    /// Memory of the process that was watched.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Memory>,
}

/// Resident memory over the load, sampled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Memory {
    /// Samples.
    pub n: usize,
    /// At the beginning.
    pub first_bytes: u64,
    /// The most in the second quarter of the time: the service has met its load then.
    pub early_max_bytes: u64,
    /// The most in the last quarter.
    pub late_max_bytes: u64,
}

impl Memory {
    fn of(samples: &[u64]) -> Self {
        let most = |range: std::ops::Range<usize>| samples[range].iter().copied().max().unwrap_or(0);
        let n = samples.len();
        Self {
            n,
            first_bytes: samples.first().copied().unwrap_or(0),
            early_max_bytes: most(n / 4..n / 2),
            late_max_bytes: most(n - n.div_ceil(4)..n),
        }
    }
}

#[derive(Default)]
struct Tally {
    accepted: Times,
    refused: Times,
    n_sent: u64,
    n_without_retry_after: u64,
    n_other_status: u64,
    n_broken: u64,
}

impl Tally {
    fn merge(&mut self, other: &Self) {
        self.accepted.merge(&other.accepted);
        self.refused.merge(&other.refused);
        self.n_sent += other.n_sent;
        self.n_without_retry_after += other.n_without_retry_after;
        self.n_other_status += other.n_other_status;
        self.n_broken += other.n_broken;
    }
}

/// Asks, first as fast as a few clients can, then more than that.
///
/// # Errors
/// When the service answers nothing.
pub async fn run(options: &LoadOptions) -> io::Result<LoadReport> {
    let (warm, warm_secs) = load(options, CAPACITY_CLIENTS, None, options.warm_up).await;
    let unloaded = warm.accepted.percentiles();
    if unloaded.n == 0 {
        let what = format!(
            "{} does not answer {}; give the address that slag-edge serve prints",
            options.address, options.path
        );
        return Err(io::Error::other(what));
    }
    let capacity_per_sec = unloaded.n as f64 / warm_secs;
    let is_over = Arc::new(AtomicBool::new(false));
    let watched = options.pid.map(|pid| tokio::spawn(watch(pid, Arc::clone(&is_over), options.duration)));
    let rate = Some(capacity_per_sec * options.overload);
    let (tally, seconds) = load(options, options.n_clients, rate, options.duration).await;
    is_over.store(true, Ordering::Relaxed);
    let memory = match watched {
        Some(samples) => Some(Memory::of(&samples.await.unwrap_or_default())),
        None => None,
    };
    Ok(LoadReport {
        machine: Machine::here(),
        capacity_per_sec,
        offered_per_sec: tally.n_sent as f64 / seconds,
        n_clients: options.n_clients,
        seconds,
        unloaded,
        accepted: tally.accepted.percentiles(),
        refused: tally.refused.percentiles(),
        n_without_retry_after: tally.n_without_retry_after,
        n_other_status: tally.n_other_status,
        n_broken: tally.n_broken,
        memory,
    })
}

/// Asks with so many clients; returns what came, and the seconds it took.
async fn load(
    options: &LoadOptions,
    n_clients: usize,
    rate_per_sec: Option<f64>,
    duration: Duration,
) -> (Tally, f64) {
    let start = Instant::now();
    let period = rate_per_sec.map_or(Duration::ZERO, |rate| {
        Duration::try_from_secs_f64(n_clients as f64 / rate).unwrap_or(Duration::MAX)
    });
    let clients: Vec<_> = (0..n_clients)
        .map(|i| {
            let offset = period.mul_f64(i as f64 / n_clients as f64);
            tokio::spawn(client(options.clone(), start + offset, period, start + duration))
        })
        .collect();
    let mut sum = Tally::default();
    for client in clients {
        match client.await {
            Ok(tally) => sum.merge(&tally),
            Err(_) => sum.n_broken += 1,
        }
    }
    (sum, start.elapsed().as_secs_f64())
}

/// Sends a question every `period`, or as soon as the one before is answered.
async fn client(options: LoadOptions, first: Instant, period: Duration, end: Instant) -> Tally {
    let mut tally = Tally::default();
    let mut connection: Option<BufReader<TcpStream>> = None;
    let mut next = first;
    let request = format!("GET {} HTTP/1.1\r\nhost: {}\r\n\r\n", options.path, options.address);
    loop {
        tokio::time::sleep_until(next.min(end)).await;
        let began = Instant::now();
        if began >= end {
            return tally;
        }
        tally.n_sent += 1;
        let answered = tokio::time::timeout(PATIENCE, async {
            let mut stream = match connection.take() {
                Some(stream) => stream,
                None => BufReader::new(TcpStream::connect(&options.address).await?),
            };
            stream.get_mut().write_all(request.as_bytes()).await?;
            let answer = read_answer(&mut stream).await?;
            connection = Some(stream);
            io::Result::Ok(answer)
        });
        let took = |began: Instant| began.elapsed();
        match answered.await {
            Ok(Ok(Answer { status: 200, .. })) => tally.accepted.add(took(began)),
            Ok(Ok(Answer { status: 503, has_retry_after })) => {
                tally.refused.add(took(began));
                tally.n_without_retry_after += u64::from(!has_retry_after);
            }
            Ok(Ok(_)) => tally.n_other_status += 1,
            Ok(Err(_)) | Err(_) => tally.n_broken += 1,
        }
        // What was missed is not made up for: the load is what can be sent, at most the rate.
        next = (next + period).max(Instant::now());
    }
}

struct Answer {
    status: u16,
    has_retry_after: bool,
}

/// Reads one answer with a `Content-Length`, and drops its body.
async fn read_answer(stream: &mut BufReader<TcpStream>) -> io::Result<Answer> {
    let bad = |what: &str| io::Error::new(io::ErrorKind::InvalidData, what.to_owned());
    let mut line = String::new();
    (&mut *stream).take(MAX_LINE_BYTES).read_line(&mut line).await?;
    let status =
        line.split(' ').nth(1).and_then(|status| status.parse().ok()).ok_or_else(|| bad("no status"))?;
    let (mut len_bytes, mut has_retry_after) = (0u64, false);
    loop {
        line.clear();
        if (&mut *stream).take(MAX_LINE_BYTES).read_line(&mut line).await? == 0 {
            return Err(bad("the head ends early"));
        }
        let Some((name, value)) = line.trim_end().split_once(':') else { break };
        match name.to_ascii_lowercase().as_str() {
            "content-length" => len_bytes = value.trim().parse().map_err(|_| bad("a strange length"))?,
            "retry-after" => has_retry_after = true,
            _ => {}
        }
    }
    if len_bytes > MAX_BODY_BYTES {
        return Err(bad("too long an answer"));
    }
    let copied = tokio::io::copy(&mut (&mut *stream).take(len_bytes), &mut tokio::io::sink()).await?;
    if copied == len_bytes { Ok(Answer { status, has_retry_after }) } else { Err(bad("a short answer")) }
}

/// Samples a process's resident memory, 100 times and more over the time of the load.
async fn watch(pid: u32, is_over: Arc<AtomicBool>, duration: Duration) -> Vec<u64> {
    let pause = (duration / 128).min(Duration::from_secs(1));
    let mut samples = Vec::new();
    while !is_over.load(Ordering::Relaxed) {
        samples.extend(resident_bytes(pid));
        tokio::time::sleep(pause).await;
    }
    samples
}

/// Returns a process's resident memory; `None` where the system does not tell.
fn resident_bytes(pid: u32) -> Option<u64> {
    let status = fs_err::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? << 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_compared_between_quarters() {
        let samples: Vec<u64> = (0..40).map(|i| if i == 3 { 99 } else { i }).collect();
        let expected = Memory { n: 40, first_bytes: 0, early_max_bytes: 19, late_max_bytes: 39 };
        assert_eq!(Memory::of(&samples), expected);
        assert_eq!(Memory::of(&[]), Memory::default());
        assert_eq!(Memory::of(&[5]).late_max_bytes, 5);
        if cfg!(target_os = "linux") {
            assert!(resident_bytes(std::process::id()).is_some_and(|bytes| bytes > 1 << 20));
        }
    }
}
