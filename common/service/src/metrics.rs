//! Counters and histograms in Prometheus' text format.
//!
//! Not `prometheus-client`: it writes OpenMetrics only, another content type, and the format takes these few lines.

use std::collections::BTreeMap;
use std::fmt::{Display, Write};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use axum::http::{HeaderValue, header};
use axum::response::{IntoResponse, Response};

#[derive(Debug, Default)]
pub struct ResponseCounts(Mutex<BTreeMap<(String, u16), u64>>);

impl ResponseCounts {
    /// Counts a response; `route` must come from a bounded set.
    pub fn count(&self, route: &str, status: u16) {
        let mut counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        *counts.entry((route.to_owned(), status)).or_default() += 1;
    }
}

#[derive(Debug)]
pub struct Histogram {
    /// Upper bounds of the buckets, seconds, ascending.
    bounds_secs: &'static [f64],
    /// Not cumulative; the last is beyond all bounds.
    counts: Vec<AtomicU64>,
    sum_us: AtomicU64,
}

impl Histogram {
    /// Makes an empty histogram with buckets up to each of `bounds_secs`, ascending, and one beyond.
    pub fn new(bounds_secs: &'static [f64]) -> Self {
        let counts = (0..=bounds_secs.len()).map(|_| AtomicU64::new(0)).collect();
        Self { bounds_secs, counts, sum_us: AtomicU64::new(0) }
    }

    pub fn observe(&self, took: Duration) {
        let seconds = took.as_secs_f64();
        let bucket = self.bounds_secs.iter().position(|bound| seconds <= *bound);
        self.counts[bucket.unwrap_or(self.bounds_secs.len())].fetch_add(1, Relaxed);
        self.sum_us.fetch_add(took.as_micros() as u64, Relaxed);
    }
}

/// The text of a scrape, the response of `GET /metrics`.
#[derive(Debug)]
pub struct Exposition {
    prefix: &'static str,
    text: String,
}

impl Exposition {
    pub const MEDIA_TYPE: &str = "text/plain; version=0.0.4";

    /// Starts a text of metrics named `prefix_...`.
    pub fn new(prefix: &'static str) -> Self {
        Self { prefix, text: String::new() }
    }

    pub fn as_str(&self) -> &str {
        &self.text
    }

    fn family(&mut self, name: &str, kind: &str, help: &str) {
        let prefix = self.prefix;
        // Writing to a String cannot fail.
        let _ = writeln!(self.text, "# HELP {prefix}_{name} {help}\n# TYPE {prefix}_{name} {kind}");
    }

    fn sample(&mut self, name: &str, suffix_and_labels: &str, value: impl Display) {
        let prefix = self.prefix;
        let _ = writeln!(self.text, "{prefix}_{name}{suffix_and_labels} {value}");
    }

    pub fn counter(&mut self, name: &str, help: &str, counter: &AtomicU64) {
        self.family(name, "counter", help);
        self.sample(name, "", counter.load(Relaxed));
    }

    pub fn gauge(&mut self, name: &str, help: &str, value: u64) {
        self.family(name, "gauge", help);
        self.sample(name, "", value);
    }

    pub fn histogram(&mut self, name: &str, help: &str, histogram: &Histogram) {
        self.family(name, "histogram", help);
        let mut cumulated = 0;
        let bounds = histogram.bounds_secs.iter().map(f64::to_string).chain(["+Inf".to_owned()]);
        for (bound, count) in bounds.zip(&histogram.counts) {
            cumulated += count.load(Relaxed);
            self.sample(name, &format!("_bucket{{le=\"{bound}\"}}"), cumulated);
        }
        self.sample(name, "_sum", histogram.sum_us.load(Relaxed) as f64 / 1e6);
        self.sample(name, "_count", cumulated);
    }

    pub fn responses(&mut self, responses: &ResponseCounts) {
        let name = "http_requests_total";
        self.family(name, "counter", "Responses by route and status.");
        let counts = responses.0.lock().unwrap_or_else(PoisonError::into_inner);
        for ((route, status), n) in counts.iter() {
            self.sample(name, &format!("{{route={route:?},status=\"{status}\"}}"), n);
        }
    }
}

impl IntoResponse for Exposition {
    fn into_response(self) -> Response {
        let content_type = HeaderValue::from_static(Self::MEDIA_TYPE);
        ([(header::CONTENT_TYPE, content_type)], self.text).into_response()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn histograms_are_cumulated() {
        let histogram = Histogram::new(&[0.5, 2.0]);
        for millis in [500, 501, 2000, 2001, 1] {
            histogram.observe(Duration::from_millis(millis));
        }
        let mut text = Exposition::new("t");
        text.histogram("took_seconds", "Time.", &histogram);
        text.gauge("level", "Level.", 3);
        let expected = "# HELP t_took_seconds Time.\n# TYPE t_took_seconds histogram\n\
            t_took_seconds_bucket{le=\"0.5\"} 2\nt_took_seconds_bucket{le=\"2\"} 4\n\
            t_took_seconds_bucket{le=\"+Inf\"} 5\nt_took_seconds_sum 5.003\nt_took_seconds_count 5\n\
            # HELP t_level Level.\n# TYPE t_level gauge\nt_level 3\n";
        assert_eq!(text.as_str(), expected);
    }
}
