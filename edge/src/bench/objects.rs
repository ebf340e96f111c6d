//! Times answers of objects in process: from a text with a cached vector to ranked objects.

use std::collections::BTreeSet;
use std::io;
use std::time::Instant;

use serde::Serialize;

use super::http::given;
use super::timing::{Settings, quantile};
use crate::query::{AnswerKind, Engine, QueryRequest};
use crate::score::Budget;
use crate::store::{EdgeCache, Snapshot};

/// Times of answers of objects.
#[derive(Clone, Debug, Serialize)]
pub struct ObjectsTiming {
    /// Objects on board.
    pub n_objects: usize,
    /// Timed questions.
    pub n_runs: usize,
    /// Fewest and most answers.
    pub n_found: [usize; 2],
    /// Median time.
    pub median_ms: f64,
    /// 99th percentile.
    pub p99_ms: f64,
    /// Minimum.
    pub min_ms: f64,
}

/// Times `kind=objects` with all other parameters at their defaults; `None` if no shard has objects.
/// `queries`: unit length, at least one.
///
/// # Errors
/// A thread does not start, or a request is not answered.
pub fn time_objects(
    cache: &EdgeCache,
    snapshot: &Snapshot,
    queries: Vec<Vec<f32>>,
    settings: &Settings,
) -> io::Result<Option<ObjectsTiming>> {
    let records =
        snapshot.shards.iter().filter_map(|shard| shard.objects()).flat_map(|objects| objects.records);
    let n_objects = records.map(|record| record.id).collect::<BTreeSet<u64>>().len();
    if n_objects == 0 {
        return Ok(None);
    }
    let n_queries = queries.len();
    let engine = Engine::new(cache.clone(), given(snapshot, queries)?);
    engine.reload().map_err(io::Error::other)?;
    let (mut times_ms, mut n_found) = (Vec::new(), Vec::new());
    for at in 0..settings.n_warm_up.max(n_queries) + settings.n_runs {
        let text = (at % n_queries).to_string();
        let request = QueryRequest { kind: Some(AnswerKind::Objects), ..QueryRequest::new(&text) };
        let start = Instant::now();
        let reply = engine.answer(&request, &Budget::default()).map_err(io::Error::other)?;
        let took = start.elapsed();
        // The text model has cached every vector after the first round.
        if at >= settings.n_warm_up.max(n_queries) {
            times_ms.push(took.as_secs_f64() * 1e3);
            n_found.push(reply.answers.iter().map(|answers| answers.answers.len()).sum::<usize>());
        }
    }
    Ok(Some(ObjectsTiming {
        n_objects,
        n_runs: times_ms.len(),
        n_found: [n_found.iter().min(), n_found.iter().max()].map(|n| n.copied().unwrap_or(0)),
        median_ms: quantile(&mut times_ms, 500),
        p99_ms: quantile(&mut times_ms, 990),
        min_ms: quantile(&mut times_ms, 0),
    }))
}
