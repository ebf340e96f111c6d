//! The counters of this service.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use slag_service::metrics::{Exposition, Histogram, ResponseCounts};

use crate::fetch::follow::FollowStatus;
use crate::store::Snapshot;

/// Upper bounds of the buckets of query times, seconds: from a cached text over few centroids to a timeout.
const QUERY_BOUNDS_SECS: [f64; 11] =
    [0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128, 0.512, 2.048];

/// The counters of this service.
pub struct Metrics {
    /// Responses by route and status.
    pub responses: Arc<ResponseCounts>,
    /// Times of queries, refused ones too.
    pub query_times: Histogram,
    /// Questions without an answer.
    pub empty_answers: AtomicU64,
    /// Generations put in place.
    pub reloads: AtomicU64,
    /// Generations that did not open.
    pub reload_failures: AtomicU64,
}

impl Default for Metrics {
    fn default() -> Self {
        Self {
            responses: Arc::default(),
            query_times: Histogram::new(&QUERY_BOUNDS_SECS),
            empty_answers: AtomicU64::new(0),
            reloads: AtomicU64::new(0),
            reload_failures: AtomicU64::new(0),
        }
    }
}

impl Metrics {
    /// Returns the scrape, with gauges of the loaded generation and of following.
    pub fn render(
        &self,
        n_in_progress: usize,
        snapshot: Option<&Snapshot>,
        following: Option<&FollowStatus>,
    ) -> Exposition {
        let mut text = Exposition::new("slag_edge");
        text.responses(&self.responses);
        text.histogram(
            "query_duration_seconds",
            "Time from the request to the start of its answer.",
            &self.query_times,
        );
        text.gauge("queries_in_flight", "Queries in progress.", n_in_progress as u64);
        text.counter("empty_answers_total", "Questions that nothing matched.", &self.empty_answers);
        text.counter("reloads_total", "Generations put in place.", &self.reloads);
        text.counter("reload_failures_total", "Generations that did not open.", &self.reload_failures);
        if let Some(snapshot) = snapshot {
            text.gauge("generation", "Generation of the scene.", snapshot.manifest.generation);
            text.gauge("shards", "Shards on board.", snapshot.shards.len() as u64);
            let n_gaussians = snapshot.shards.iter().map(|shard| u64::from(shard.cell.n_gaussians)).sum();
            text.gauge("gaussians", "Gaussians on board.", n_gaussians);
        }
        if let Some(following) = following {
            let counts =
                [following.n_fetches, following.n_failures, following.n_restarts].map(AtomicU64::new);
            text.gauge(
                "follower_up",
                "Whether positions are followed.",
                u64::from(following.failure.is_none()),
            );
            text.counter("follow_fetches_total", "Successful fetches of the follower.", &counts[0]);
            text.counter("follow_failures_total", "Failed fetches of the follower.", &counts[1]);
            text.counter(
                "follower_restarts_total",
                "Times that the follower failed and began again.",
                &counts[2],
            );
        }
        text
    }
}
