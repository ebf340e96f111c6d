//! The routes of the page, with the limits of the service for robots around them.

use std::iter;
use std::sync::Arc;

use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Json, Router};
use serde::Deserialize;
use serde_json::{Value, json};
use slag_common::objects::parse_public_id;
use slag_service::params::{Params, PathText, RequestError};
use slag_service::problem::Problem;
use slag_view::{Description, Step, Words};

use super::error::ViewError;
use super::viewer::Viewer;
use crate::diff::Diff;

/// Answers per page of `/v1/query` by default.
const DEFAULT_LIMIT: usize = 10;
const MAX_LIMIT: usize = 1000;
const MAX_NEGATIVES: usize = 32;
const MAX_PHOTO_BYTES: u64 = 64 << 20;
const BINARY: [(header::HeaderName, &str); 1] = [(header::CONTENT_TYPE, "application/octet-stream")];

type AppState = State<Arc<Viewer>>;

#[derive(Deserialize)]
struct CellParams {
    generation: Option<u64>,
    step: Option<String>,
}

#[derive(Deserialize)]
struct Question {
    text: String,
    #[serde(default)]
    negative: Vec<String>,
}

#[derive(Deserialize)]
struct Page {
    limit: Option<usize>,
}

pub(crate) fn router(viewer: Viewer) -> Router {
    Router::new()
        .route("/v1/changes", axum::routing::get(changes))
        .route("/v1/view", axum::routing::get(describe))
        .route("/v1/view/scores", axum::routing::get(scores))
        .route("/v1/view/words", axum::routing::get(words))
        .route("/v1/view/cells/{id}", axum::routing::get(cell))
        .route("/v1/view/photos/{number}", axum::routing::get(photo))
        .route("/v1/objects/{id}/thumbnail", axum::routing::get(thumbnail))
        .route("/v1/query", axum::routing::get(query))
        .merge(slag_view::router())
        .with_state(Arc::new(viewer))
}

async fn blocking<T: Send + 'static>(
    viewer: Arc<Viewer>,
    work: impl FnOnce(&Viewer) -> Result<T, ViewError> + Send + 'static,
) -> Result<T, Problem> {
    let done = tokio::task::spawn_blocking(move || work(&viewer)).await.map_err(Problem::internal)?;
    Ok(done?)
}

async fn describe(State(viewer): AppState) -> Result<Json<Description>, Problem> {
    blocking(viewer, Viewer::describe).await.map(Json)
}

async fn words(State(viewer): AppState) -> Result<Json<Words>, Problem> {
    blocking(viewer, Viewer::words).await.map(Json)
}

async fn cell(
    State(viewer): AppState,
    PathText(id): PathText,
    Params(CellParams { generation, step }): Params<CellParams>,
) -> Result<Response, Problem> {
    let cell_id = number("id", &id)?;
    let step = step.map_or(Ok(Step::ALL), |value| {
        Step::parse(&value).map_err(|expected| RequestError::new("step", &value, expected))
    })?;
    let bytes = blocking(viewer, move |viewer| viewer.cell(cell_id, generation, step)).await?;
    Ok((BINARY, bytes).into_response())
}

async fn scores(State(viewer): AppState, Params(asked): Params<Question>) -> Result<Response, Problem> {
    let Question { text, negative: negatives } = asked.checked()?;
    let work = move |viewer: &Viewer| {
        viewer.asked(&text, &negatives, |generation, vectors| generation.scores(vectors))
    };
    Ok((BINARY, blocking(viewer, work).await?).into_response())
}

async fn query(
    State(viewer): AppState,
    Params((asked, page)): Params<(Question, Page)>,
) -> Result<Json<Value>, Problem> {
    let Question { text, negative: negatives } = asked.checked()?;
    let limit = page.limit.unwrap_or(DEFAULT_LIMIT).min(MAX_LIMIT);
    let work = move |viewer: &Viewer| {
        let mut reply = viewer.asked(&text, &negatives, |generation, vectors| {
            Ok(generation.things.answers(generation.reader.manifest(), &text, vectors, limit))
        })?;
        let texts: Vec<String> = iter::once(text).chain(negatives).collect();
        reply["results"][0]["asked_as"] = json!(viewer.asked_as(&texts)?);
        Ok(reply)
    };
    blocking(viewer, work).await.map(Json)
}

async fn changes(State(viewer): AppState) -> Result<Json<Diff>, Problem> {
    blocking(viewer, |viewer| viewer.changes()).await.map(Json)
}

async fn thumbnail(State(viewer): AppState, PathText(id): PathText) -> Result<Response, Problem> {
    let wanted = parse_public_id(&id).ok_or_else(|| RequestError::new("id", &id, "o and 16 hex digits"))?;
    let picture = blocking(viewer, move |viewer| viewer.thumbnail(wanted)).await?;
    let gone = || {
        let detail = format!("the store has no picture of {id}");
        Problem::new(StatusCode::NOT_FOUND, "no-thumbnail", "No thumbnail", detail)
    };
    Ok(([(header::CONTENT_TYPE, "image/jpeg")], picture.ok_or_else(gone)?).into_response())
}

/// A photo as it lies on disk, by its index in the description.
async fn photo(State(viewer): AppState, PathText(number): PathText) -> Result<Response, Problem> {
    let number: usize = self::number("number", &number)?;
    let path = viewer.photo(number);
    let gone = |detail: String| Problem::new(StatusCode::NOT_FOUND, "no-such-photo", "No such photo", detail);
    let path = path.ok_or_else(|| gone(format!("there is no photo {number}; GET /v1/view lists them")))?;
    let work = move || match std::fs::metadata(&path) {
        Ok(about) if about.is_file() && about.len() <= MAX_PHOTO_BYTES => fs_err::read(&path).ok(),
        _ => None,
    };
    let bytes = tokio::task::spawn_blocking(work).await.map_err(Problem::internal)?;
    let bytes =
        bytes.ok_or_else(|| gone(format!("the file of photo {number} cannot be read, or is too long")))?;
    let kind = image::guess_format(&bytes).map_or("application/octet-stream", |format| format.to_mime_type());
    Ok(([(header::CONTENT_TYPE, kind)], bytes).into_response())
}

fn number<T: std::str::FromStr>(name: &str, value: &str) -> Result<T, RequestError> {
    value.parse().map_err(|_| RequestError::new(name, value, "a whole number"))
}

impl Question {
    fn checked(self) -> Result<Self, RequestError> {
        let n = self.negative.len();
        if n > MAX_NEGATIVES {
            let expected = format!("at most {MAX_NEGATIVES} of them");
            return Err(RequestError::new("negative", &n.to_string(), expected));
        }
        match self.text.trim().is_empty() {
            true => Err(RequestError::new("text", &self.text, "words to look for")),
            false => Ok(self),
        }
    }
}
