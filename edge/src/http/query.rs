//! `GET /query`: short answers whole, long ones piece by piece.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::http::{HeaderMap, HeaderValue, Uri, header};
use hyper::body::Frame;
use schemars::SchemaGenerator;
use slag_service::problem::Problem;
use slag_service::replies::{As, Binary, Described, Reply};
use tokio::sync::mpsc::{Receiver, Sender, channel};

use super::app::App;
use super::params;
use super::problem::{parameter_problem, query_problem};
use crate::query::{AnswersOrBatch, Format, QueryRequest, RequestError};

/// Pieces made ahead of the client.
const PIECES_AHEAD: usize = 2;

const ARROW: &str = "Columns question (u32, of a batch), x, y, z (f64), score (f32), cell, index (u32). Metadata: scene, generation, frame, unit, score_kind, threshold, score_error_bound, questions (JSON: Answers of each text, without answers), geo_reference.";
const PLY: &str = "format=ply: a binary little-endian PLY with an element vertex of uint question (of a batch), answer (rank of the answer, from 1), double x, y, z, float score, uint cell, index, and input_index (in the input splat file) if every shard knows it. Comments: text, scene, generation, unit.";

type Pairs = Query<Vec<(String, String)>>;

fn no_pairs(found: &str) -> RequestError {
    RequestError::new("query string", found, "name=value pairs")
}

/// Reads the query string of `/query`; [`QueryRequest::check`] checks the values.
///
/// # Errors
/// The first wrong parameter, or the string if it is no query string.
pub fn parse_query(query_string: &str) -> Result<QueryRequest, RequestError> {
    let uri: Result<Uri, _> = format!("/query?{query_string}").parse();
    let uri = uri.map_err(|e| no_pairs(&e.to_string()))?;
    let pairs = Pairs::try_from_uri(&uri).map_err(|e| no_pairs(&e.body_text()))?;
    Ok(params::parse(&pairs, &HeaderMap::new())?.0)
}

pub async fn query(
    State(app): State<Arc<App>>,
    headers: HeaderMap,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<As<Formats>, Problem> {
    let started = Instant::now();
    let answer = answer(&app, &headers, pairs).await;
    app.metrics.query_times.observe(started.elapsed());
    answer
}

async fn answer(
    app: &Arc<App>,
    headers: &HeaderMap,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<As<Formats>, Problem> {
    let Query(pairs) = pairs.map_err(|e| parameter_problem(no_pairs(&e.body_text())))?;
    let (request, format) = params::parse(&pairs, headers).map_err(parameter_problem)?;
    request.check().map_err(parameter_problem)?;
    let answering = app.within_limits(None, move |app, budget| {
        let reply = app.engine.answer(&request, budget).map_err(query_problem)?;
        let n_empty = reply.answers.iter().filter(|answers| answers.answers.is_empty()).count();
        app.metrics.empty_answers.fetch_add(n_empty as u64, Ordering::Relaxed);
        let mut pieces = reply.pieces(format).peekable();
        let first = pieces.next().transpose().map_err(Problem::internal)?.unwrap_or_default();
        let is_whole = pieces.peek().is_none();
        // What the answers take counts until they are sent.
        Ok((first, (!is_whole).then(|| (pieces, budget.clone()))))
    });
    let (first, rest) = answering.await?;
    let body = match rest {
        None => Body::from(first),
        Some((pieces, budget)) => {
            let (sender, receiver) = channel(PIECES_AHEAD);
            let deadline = app.settings.stream_timeout;
            tokio::spawn(async move {
                let _held = budget;
                send_all(first, pieces, sender, deadline).await;
            });
            Body::new(Pieces { receiver, is_complete: false })
        }
    };
    Ok(As::new(([(header::CONTENT_TYPE, HeaderValue::from_static(format.media_type()))], body)))
}

/// Answers in any format of this build.
pub struct Formats;

impl Described for Formats {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        let formats = Format::available().iter().map(|format| {
            let mut bytes = Binary::schema();
            let schema = match format {
                Format::Json => schemas.subschema_for::<AnswersOrBatch>(),
                Format::Arrow => {
                    bytes.insert("description".into(), ARROW.into());
                    bytes
                }
                Format::Ply => {
                    bytes.insert("description".into(), PLY.into());
                    bytes
                }
            };
            (format.media_type(), schema)
        });
        vec![Reply { content: formats.collect(), ..Reply::ok("", Binary::schema()) }]
    }
}

/// A message to the body.
enum Message {
    Piece(Bytes),
    End,
}

/// Sends the pieces, each made off the async threads once the client took those before.
///
/// It gives up at the deadline: a slow or silent client does not hold the answers for longer.
async fn send_all(
    first: Vec<u8>,
    pieces: impl Iterator<Item = io::Result<Vec<u8>>> + Send + 'static,
    to: Sender<Message>,
    deadline: Duration,
) {
    let sending = async {
        let (mut piece, mut pieces) = (Some(Ok(first)), pieces);
        while let Some(Ok(bytes)) = piece {
            if to.send(Message::Piece(bytes.into())).await.is_err() {
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
            _ => drop(to.send(Message::End).await),
        }
    };
    if tokio::time::timeout(deadline, sending).await.is_err() {
        tracing::warn!("an answer was cut off: its client took more than {} s", deadline.as_secs_f64());
    }
}

/// A body that ends complete or with an error: a cut-off answer must not look complete.
struct Pieces {
    receiver: Receiver<Message>,
    is_complete: bool,
}

impl hyper::body::Body for Pieces {
    type Data = Bytes;
    type Error = io::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, io::Error>>> {
        if self.is_complete {
            return Poll::Ready(None);
        }
        Poll::Ready(match ready!(self.receiver.poll_recv(context)) {
            Some(Message::Piece(bytes)) => Some(Ok(Frame::data(bytes))),
            Some(Message::End) => {
                self.is_complete = true;
                None
            }
            None => {
                self.is_complete = true;
                Some(Err(io::Error::new(io::ErrorKind::TimedOut, "the answer was cut off")))
            }
        })
    }
}
