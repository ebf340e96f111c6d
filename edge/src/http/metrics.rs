//! Counters and a latency histogram in Prometheus' text format.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use crate::store::Snapshot;

/// Upper bounds of the histogram's buckets, seconds: from a cached text over few rows to a timeout.
const BUCKETS_SECS: [f64; 11] =
    [0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128, 0.512, 2.048];

/// What is counted.
#[derive(Default)]
pub struct Metrics {
    /// By route and status.
    requests: Mutex<BTreeMap<(&'static str, u16), u64>>,
    /// Queries by bucket, not cumulated; the last is beyond all bounds.
    latency: [AtomicU64; BUCKETS_SECS.len() + 1],
    latency_sum_us: AtomicU64,
    /// Queries without an answer to give.
    pub empty_answers: AtomicU64,
    /// Generations that were put in place.
    pub reloads: AtomicU64,
    /// Generations that did not open.
    pub reload_failures: AtomicU64,
}

impl Metrics {
    /// Counts a response.
    pub fn count_response(&self, route: &'static str, status: u16) {
        let mut requests = self.requests.lock().unwrap_or_else(PoisonError::into_inner);
        *requests.entry((route, status)).or_default() += 1;
    }

    /// Counts the time one query took.
    pub fn observe_query(&self, took: Duration) {
        let seconds = took.as_secs_f64();
        let bucket = BUCKETS_SECS.iter().position(|bound| seconds <= *bound).unwrap_or(BUCKETS_SECS.len());
        self.latency[bucket].fetch_add(1, Relaxed);
        self.latency_sum_us.fetch_add(took.as_micros() as u64, Relaxed);
    }

    /// Returns the text, with gauges of what is loaded.
    pub fn render(&self, in_flight: usize, snapshot: Option<&Snapshot>) -> String {
        let mut out = String::new();
        let mut family = |name: &str, kind: &str, help: &str, samples: &[(String, String)]| {
            // Writing to a String cannot fail.
            let _ = writeln!(out, "# HELP slag_edge_{name} {help}\n# TYPE slag_edge_{name} {kind}");
            for (labels, value) in samples {
                let _ = writeln!(out, "slag_edge_{name}{labels} {value}");
            }
        };
        let single = |value: u64| vec![(String::new(), value.to_string())];
        let requests: Vec<(String, String)> = {
            let requests = self.requests.lock().unwrap_or_else(PoisonError::into_inner);
            let sample = |((route, status), n): (&(&str, u16), &u64)| {
                (format!("{{route={route:?},status=\"{status}\"}}"), n.to_string())
            };
            requests.iter().map(sample).collect()
        };
        family("http_requests_total", "counter", "Responses by route and status.", &requests);

        let mut cumulated = 0;
        let mut samples = Vec::new();
        let bounds = BUCKETS_SECS.iter().map(f64::to_string).chain(["+Inf".to_owned()]);
        for (bound, count) in bounds.zip(&self.latency) {
            cumulated += count.load(Relaxed);
            samples.push((format!("_bucket{{le=\"{bound}\"}}"), cumulated.to_string()));
        }
        let sum_secs = self.latency_sum_us.load(Relaxed) as f64 / 1e6;
        samples.push(("_sum".into(), sum_secs.to_string()));
        samples.push(("_count".into(), cumulated.to_string()));
        family("query_duration_seconds", "histogram", "Time from the request to its answer.", &samples);

        let counted = |counter: &AtomicU64| single(counter.load(Relaxed));
        family("queries_in_flight", "gauge", "Queries being answered.", &single(in_flight as u64));
        family(
            "empty_answers_total",
            "counter",
            "Queries that nothing matched.",
            &counted(&self.empty_answers),
        );
        family("reloads_total", "counter", "Generations put in place.", &counted(&self.reloads));
        family(
            "reload_failures_total",
            "counter",
            "Generations that did not open.",
            &counted(&self.reload_failures),
        );
        if let Some(snapshot) = snapshot {
            family("generation", "gauge", "Generation of the scene.", &single(snapshot.manifest.generation));
            family("shards", "gauge", "Shards on board.", &single(snapshot.shards.len() as u64));
            let n_gaussians = snapshot.shards.iter().map(|shard| u64::from(shard.cell.n_gaussians)).sum();
            family("gaussians", "gauge", "Gaussians on board.", &single(n_gaussians));
        }
        out
    }
}
