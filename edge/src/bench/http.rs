//! Times whole requests over loopback, as Arrow columns: the cost that the service adds to an answer.

use std::io;
use std::time::Instant;

use serde::Serialize;
use slag_models::{InferenceError, TextEncoder};
use tokio::net::TcpListener;

use super::timing::{Kind, Settings, Timing, quantile};
use crate::http::{self, App};
use crate::query::{Engine, MAX_GAUSSIANS};
use crate::store::{EdgeCache, Snapshot};
use crate::text::{EncoderInfo, TextService};

/// Times of requests at one limit.
#[derive(Clone, Debug, Serialize)]
pub struct HttpTiming {
    /// Number of Gaussians asked for.
    pub limit: usize,
    /// Timed requests.
    pub n_runs: usize,
    /// Bytes of the largest body.
    pub body_bytes: usize,
    /// Median time, from the request to the body's last byte.
    pub median_ms: f64,
    /// 99th percentile.
    pub p99_ms: f64,
    /// The median less that of the same answer in process.
    pub added_ms: f64,
}

/// A text model whose texts are indices of given vectors.
struct Given(Vec<Vec<f32>>);

impl TextEncoder for Given {
    fn name(&self) -> &str {
        "given vectors"
    }

    fn dim(&self) -> usize {
        self.0.first().map_or(0, Vec::len)
    }

    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError> {
        let known = text.parse().ok().and_then(|at: usize| self.0.get(at)).cloned();
        known.ok_or(InferenceError::EmptyText)
    }
}

/// Starts a text model in a scene's embedding space whose texts are indices of given vectors.
pub(super) fn given(snapshot: &Snapshot, queries: Vec<Vec<f32>>) -> io::Result<TextService> {
    let encoder = &snapshot.manifest.encoder;
    let (name, id) = (encoder.name.clone(), encoder.id);
    let info = EncoderInfo { name, id, dim: encoder.dim, execution_provider: "none" };
    TextService::start(info, Box::new(Given(queries)))
}

/// Times requests for the best Gaussians of a cache. `queries`: unit length, at least one. `in_process`:
/// times of the same answers without the service. Skips limits that the service refuses.
///
/// # Errors
/// A socket fails, or a request gets no answer.
pub fn time_http(
    cache: &EdgeCache,
    snapshot: &Snapshot,
    queries: Vec<Vec<f32>>,
    settings: &Settings,
    in_process: &[Timing],
) -> io::Result<Vec<HttpTiming>> {
    let n_queries = queries.len();
    let text = given(snapshot, queries)?;
    let app = App::new(Engine::new(cache.clone(), text), http::Settings::default());
    app.reload_now();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let service = runtime.block_on(async {
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let service = format!("http://{}", listener.local_addr()?);
        tokio::spawn(http::serve(app, listener, std::future::pending()));
        io::Result::Ok(service)
    })?;
    let agent: ureq::Agent = ureq::Agent::config_builder().proxy(None).build().into();
    let mut timings = Vec::new();
    for limit in settings.limits.iter().copied().filter(|limit| *limit <= MAX_GAUSSIANS) {
        let (mut times_ms, mut body_bytes) = (Vec::new(), 0);
        for at in 0..settings.n_warm_up + settings.n_runs {
            let (text, precision) = (at % n_queries, settings.precision);
            let url = format!(
                "{service}/query?text={text}&limit={limit}&precision={precision}&threshold=-1&kind=gaussians&format=arrow"
            );
            let start = Instant::now();
            let answer = agent.get(&url).call();
            let body = answer.and_then(|mut a| a.body_mut().with_config().limit(u64::MAX).read_to_vec());
            let body = body.map_err(io::Error::other)?;
            if at >= settings.n_warm_up {
                times_ms.push(start.elapsed().as_secs_f64() * 1e3);
                body_bytes = body_bytes.max(body.len());
            }
        }
        let n_runs = times_ms.len();
        let same = in_process.iter().find(|timing| timing.limit == limit && timing.kind == Kind::Best);
        let (median_ms, p99_ms) = (quantile(&mut times_ms, 500), quantile(&mut times_ms, 990));
        let added_ms = median_ms - same.map_or(0.0, |timing| timing.median_ms);
        timings.push(HttpTiming { limit, n_runs, body_bytes, median_ms, p99_ms, added_ms });
    }
    runtime.shutdown_background();
    Ok(timings)
}
