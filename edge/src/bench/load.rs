//! Loads a service with more queries than it can answer, using a paced HTTP client.

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

/// Longest answer body accepted.
const MAX_BODY_BYTES: u64 = 64 << 20;
const MAX_LINE_BYTES: u64 = 16 << 10;
/// Timeout of one answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(30);
/// Concurrent queries while the capacity is measured.
const CAPACITY_CLIENTS: usize = 4;

/// Parameters of a load test.
#[derive(Clone, Debug)]
pub struct LoadOptions {
    /// `IP:PORT` of the service.
    pub address: String,
    /// The request path, percent-encoded.
    pub path: String,
    /// Concurrent queries.
    pub n_clients: usize,
    /// Queries offered per second, as a multiple of the service's capacity.
    pub overload: f64,
    /// Time to measure the capacity.
    pub warm_up: Duration,
    /// Duration of the load.
    pub duration: Duration,
    /// Process to sample the memory of.
    pub pid: Option<u32>,
}

/// Report of a load test.
#[derive(Clone, Debug, Serialize)]
pub struct LoadReport {
    /// The machine.
    pub machine: Machine,
    /// Answers per second without overload.
    pub capacity_per_sec: f64,
    /// Queries sent per second under load.
    pub offered_per_sec: f64,
    /// Most concurrent queries.
    pub n_clients: usize,
    /// Seconds of load.
    pub seconds: f64,
    /// Response times without overload.
    pub unloaded: Percentiles,
    /// Response times of answers under load.
    pub accepted: Percentiles,
    /// Response times of refusals (503).
    pub refused: Percentiles,
    /// Refusals without `Retry-After`.
    pub n_without_retry_after: u64,
    /// Answers with any other status.
    pub n_other_status: u64,
    /// Broken connections and missing answers.
    pub n_broken: u64,
    /// Kept connections that were closed when the next query came, which a new one then carried.
    pub n_reopened: u64,
    /// Memory of the sampled process.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Memory>,
}

/// Resident memory during the load.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Memory {
    /// Number of samples.
    pub n: usize,
    /// At the beginning.
    pub first_bytes: u64,
    /// Maximum in the second quarter of the time, when the service has reached its load.
    pub early_max_bytes: u64,
    /// Maximum in the last quarter.
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
    n_reopened: u64,
}

impl Tally {
    fn merge(&mut self, other: &Self) {
        self.accepted.merge(&other.accepted);
        self.refused.merge(&other.refused);
        self.n_sent += other.n_sent;
        self.n_without_retry_after += other.n_without_retry_after;
        self.n_other_status += other.n_other_status;
        self.n_broken += other.n_broken;
        self.n_reopened += other.n_reopened;
    }
}

/// Measures the capacity with a few clients, then loads the service beyond it.
///
/// # Errors
/// The service does not answer.
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
        n_reopened: tally.n_reopened,
        memory,
    })
}

/// Sends queries from `n_clients` clients; returns the outcome and the seconds taken.
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

/// Sends a query every `period`, or as soon as the previous one is answered.
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
        let answered = tokio::time::timeout(ANSWER_TIMEOUT, async {
            // The service may have closed a connection that was idle since the last query.
            if let Some(kept) = connection.take() {
                match ask(kept, &request).await {
                    Ok(answer) => return Ok(answer),
                    Err(_) => tally.n_reopened += 1,
                }
            }
            ask(BufReader::new(TcpStream::connect(&options.address).await?), &request).await
        });
        match answered.await {
            Ok(Ok((answer, kept))) => {
                connection = Some(kept);
                match answer {
                    Answer { status: 200, .. } => tally.accepted.add(began.elapsed()),
                    Answer { status: 503, has_retry_after } => {
                        tally.refused.add(began.elapsed());
                        tally.n_without_retry_after += u64::from(!has_retry_after);
                    }
                    Answer { .. } => tally.n_other_status += 1,
                }
            }
            Ok(Err(_)) | Err(_) => tally.n_broken += 1,
        }
        // Missed queries are not made up for: the load never exceeds the rate.
        next = (next + period).max(Instant::now());
    }
}

/// Sends a request and reads its answer; returns the connection, too.
async fn ask(mut stream: BufReader<TcpStream>, request: &str) -> io::Result<(Answer, BufReader<TcpStream>)> {
    stream.get_mut().write_all(request.as_bytes()).await?;
    let answer = read_answer(&mut stream).await?;
    Ok((answer, stream))
}

struct Answer {
    status: u16,
    has_retry_after: bool,
}

/// Reads one answer with a `Content-Length` and discards its body.
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

/// Samples a process's resident memory, at least 100 times during the load.
async fn watch(pid: u32, is_over: Arc<AtomicBool>, duration: Duration) -> Vec<u64> {
    let pause = (duration / 128).min(Duration::from_secs(1));
    let mut samples = Vec::new();
    while !is_over.load(Ordering::Relaxed) {
        samples.extend(resident_bytes(pid));
        tokio::time::sleep(pause).await;
    }
    samples
}

/// Returns a process's resident memory; `None` if the system does not report it.
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
