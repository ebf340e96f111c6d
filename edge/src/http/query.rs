//! `GET /query`, `GET` and `POST /v1/query`: short answers whole, long ones streamed.

use std::io;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use axum::Json;
use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, Uri, header};
use axum::response::Response;
use futures_util::stream::try_unfold;
use schemars::SchemaGenerator;
use slag_service::params::Params;
use slag_service::problem::Problem;
use slag_service::replies::{As, Binary, Described, Reply};
use tokio::sync::mpsc::{Sender, channel};

use super::app::App;
use super::ask::{AskParams, ShortParams, as_in_json};
use super::forms::AreaParams;
use crate::query::{AnswersOrBatch, Ask, Format, Page, RequestError};

/// Longest body: 32 vectors of 2048 components as text.
pub const MAX_BODY_BYTES: usize = 1 << 20;
/// Longest reason for refusing a body.
const MAX_REASON_CHARS: usize = 300;
/// Pieces made ahead of the client.
const PIECES_AHEAD: usize = 2;

#[cfg(feature = "arrow")]
const ARROW: &str = "Columns question (u32, of a batch), x, y, z (f64), score (f32), cell, index (u32). Metadata: scene, generation, frame, unit, score_kind, threshold, score_error_bound, questions (JSON: Answers of each text, without answers), geo_reference.";
const PLY: &str = "format=ply: a binary little-endian PLY with an element vertex of uint question (of a batch), answer (rank of the answer, from 1), double x, y, z, float score, uint cell, index, and input_index (in the input splat file) if every shard knows it. Comments: text, scene, generation, unit.";

/// Parses the query string of `/query`, without the checks that need a scene.
///
/// # Errors
/// The first wrong parameter, or the string if it is no query string.
pub fn parse_query(query_string: &str) -> Result<Ask, RequestError> {
    let uri: Result<Uri, _> = format!("/query?{query_string}").parse();
    let uri = uri.map_err(|e| RequestError::new("query string", &e.to_string(), "name=value pairs"))?;
    let (area, short, params) = Params::<(AreaParams, ShortParams, AskParams)>::parse(&uri)?;
    short.ask(params, area, &HeaderMap::new())
}

pub async fn short(
    State(app): State<Arc<App>>,
    headers: HeaderMap,
    params: Result<Params<(AreaParams, ShortParams, AskParams)>, Problem>,
) -> Result<As<Formats>, Problem> {
    let ask = params.and_then(|Params((area, short, params))| Ok(short.ask(params, area, &headers)?));
    answer(&app, ask).await.map(As::new)
}

pub async fn get(
    State(app): State<Arc<App>>,
    params: Result<Params<(AreaParams, AskParams)>, Problem>,
) -> Result<As<Json<Page<'static>>>, Problem> {
    answer(&app, params.and_then(|Params((area, params))| Ok(params.ask(area)?))).await.map(As::new)
}

pub async fn post(State(app): State<Arc<App>>, body: Bytes) -> Result<As<Json<Page<'static>>>, Problem> {
    let read = serde_json::from_slice(body.strip_prefix("\u{feff}".as_bytes()).unwrap_or(&body));
    let ask = read.map_err(|error| unreadable(&error));
    let named = as_in_json(ask.as_ref().ok());
    answer(&app, ask).await.map(As::new).map_err(named)
}

/// Returns the problem of an invalid body; serde's text names the member and its allowed names.
fn unreadable(error: &serde_json::Error) -> Problem {
    let (mut text, expected) = (error.to_string(), "a request as GET /openapi.json describes it");
    for (type_in_rust, in_words) in
        [("usize", "a whole number"), ("u32", "a whole number"), ("f32", "a number"), ("f64", "a number")]
    {
        text = text.replace(&format!("expected {type_in_rust}"), &format!("expected {in_words}"));
    }
    let shown: String = text.chars().take(MAX_REASON_CHARS).collect();
    let dots = if shown.len() < text.len() { "…" } else { "" };
    let problem = Problem::from(RequestError::new("body", &text, expected));
    problem.with_detail(format!("body: {shown}{dots}; expected {expected}"))
}

async fn answer(app: &Arc<App>, ask: Result<Ask, Problem>) -> Result<Response, Problem> {
    let started = Instant::now();
    let answer = async { answer_within_limits(app, ask?).await }.await;
    app.metrics.query_times.observe(started.elapsed());
    answer
}

async fn answer_within_limits(app: &Arc<App>, ask: Ask) -> Result<Response, Problem> {
    let format = ask.format;
    // Before the clock starts: a budget of zero is refused, not overrun.
    let answering = app.within_limits(ask.time_budget()?, move |app, budget| {
        let reply = app.engine.ask(ask, budget)?;
        let n_empty = reply.answers.iter().filter(|of| of.answers.is_empty()).count();
        app.metrics.empty_answers.fetch_add(n_empty as u64, Ordering::Relaxed);
        let Some(format) = format else {
            return Ok((serde_json::to_vec(&Page::of(&reply)).map_err(Problem::internal)?, None));
        };
        let mut pieces = Arc::new(reply).pieces(format).peekable();
        let first = pieces.next().transpose().map_err(Problem::internal)?.unwrap_or_default();
        let is_whole = pieces.peek().is_none();
        // The answers' bytes stay charged until they are sent.
        Ok((first, (!is_whole).then(|| (pieces, budget.clone()))))
    });
    let (first, rest) = answering.await?;
    let body = match rest {
        None => Body::from(first),
        Some((pieces, budget)) => {
            let (sender, receiver) = channel::<Option<Bytes>>(PIECES_AHEAD);
            let deadline = app.settings.stream_timeout;
            tokio::spawn(async move {
                let _held = budget;
                send_all(first, pieces, sender, deadline).await;
            });
            Body::from_stream(try_unfold(receiver, |mut pieces| async move {
                match pieces.recv().await {
                    Some(piece) => Ok(piece.map(|piece| (piece, pieces))),
                    None => Err(io::Error::new(io::ErrorKind::TimedOut, "the answer was cut off")),
                }
            }))
        }
    };
    let mut response = Response::new(body);
    let media_type = HeaderValue::from_static(format.unwrap_or_default().media_type());
    response.headers_mut().insert(header::CONTENT_TYPE, media_type);
    Ok(response)
}

pub struct Formats;

impl Described for Formats {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        let bytes = |description: &str| {
            let mut schema = Binary::schema();
            schema.insert("description".into(), description.into());
            schema
        };
        let content = vec![
            (Format::Json.media_type(), schemas.subschema_for::<AnswersOrBatch>()),
            #[cfg(feature = "arrow")]
            (Format::Arrow.media_type(), bytes(ARROW)),
            (Format::Ply.media_type(), bytes(PLY)),
        ];
        vec![Reply { content, ..Reply::ok("", Binary::schema()) }]
    }
}

/// Sends the pieces and then `None`; each is made off the async threads once the client took the previous one.
///
/// Gives up at the deadline: a slow or silent client must not hold the answers longer.
async fn send_all(
    first: Vec<u8>,
    pieces: impl Iterator<Item = io::Result<Vec<u8>>> + Send + 'static,
    to: Sender<Option<Bytes>>,
    deadline: Duration,
) {
    let sending = async {
        let (mut piece, mut pieces) = (Some(Ok(first)), pieces);
        while let Some(Ok(bytes)) = piece {
            if to.send(Some(bytes.into())).await.is_err() {
                tracing::debug!("a client left before its answer ended");
                return;
            }
            let next = tokio::task::spawn_blocking(move || (pieces.next(), pieces)).await;
            (piece, pieces) = match next {
                Ok(next) => next,
                Err(error) => return tracing::error!("an answer broke off: {error}"),
            };
        }
        match piece {
            Some(Err(error)) => tracing::error!("an answer broke off: {error}"),
            // Nothing is lost if the client is gone.
            _ => drop(to.send(None).await),
        }
    };
    if tokio::time::timeout(deadline, sending).await.is_err() {
        tracing::warn!("an answer was cut off: its client took more than {} s", deadline.as_secs_f64());
    }
}
