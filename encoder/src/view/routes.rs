//! The routes of the page, with the limits of the service for robots around them.

use std::iter;
use std::sync::Arc;

use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Json, Router};
use serde_json::{Value, json};
use slag_common::objects::parse_public_id;
use slag_service::params::PathText;
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
type Pairs = Result<Query<Vec<(String, String)>>, QueryRejection>;

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

async fn cell(State(viewer): AppState, PathText(id): PathText, pairs: Pairs) -> Result<Response, Problem> {
    let pairs = read(pairs, &["generation", "step"])?;
    let cell_id = number("id", &id)?;
    let of = |wanted: &str| pairs.iter().find(|(name, _)| name == wanted);
    let generation = of("generation").map(|(name, value)| number(name, value)).transpose()?;
    let step = of("step").map_or(Ok(Step::ALL), |(_, value)| Step::parse(value));
    let step = step.map_err(|expected| bad(format!("step: expected {expected}")))?;
    let bytes = blocking(viewer, move |viewer| viewer.cell(cell_id, generation, step)).await?;
    Ok((BINARY, bytes).into_response())
}

async fn scores(State(viewer): AppState, pairs: Pairs) -> Result<Response, Problem> {
    let (text, negatives) = question(&read(pairs, &["text", "negative"])?)?;
    let work = move |viewer: &Viewer| {
        viewer.asked(&text, &negatives, |generation, vectors| generation.scores(vectors))
    };
    Ok((BINARY, blocking(viewer, work).await?).into_response())
}

async fn query(State(viewer): AppState, pairs: Pairs) -> Result<Json<Value>, Problem> {
    let pairs = read(pairs, &["text", "negative", "limit"])?;
    let (text, negatives) = question(&pairs)?;
    let limit = pairs.iter().find(|(name, _)| name == "limit");
    let limit = limit.map_or(Ok(DEFAULT_LIMIT), |(name, value)| number(name, value))?.min(MAX_LIMIT);
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
    let wanted = parse_public_id(&id).ok_or_else(|| bad("id: expected o and 16 hex digits"))?;
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

fn bad(detail: impl Into<String>) -> Problem {
    Problem::new(StatusCode::BAD_REQUEST, "bad-parameter", "Bad parameter", detail)
}

/// Refuses unknown parameters.
fn read(pairs: Pairs, known: &[&str]) -> Result<Vec<(String, String)>, Problem> {
    let Query(pairs) = pairs.map_err(|e| bad(e.body_text()))?;
    match pairs.iter().find(|(name, _)| !known.contains(&name.as_str())) {
        Some((name, _)) => {
            let name: String = name.chars().take(40).collect();
            Err(bad(format!("{:?} is unknown, expected one of {}", name, known.join(", "))))
        }
        None => Ok(pairs),
    }
}

fn number<T: std::str::FromStr>(name: &str, value: &str) -> Result<T, Problem> {
    let shown = || value.chars().take(40).collect::<String>();
    value.parse().map_err(|_| bad(format!("{name} is {:?}, expected a whole number", shown())))
}

fn question(pairs: &[(String, String)]) -> Result<(String, Vec<String>), Problem> {
    let of = |wanted: &'static str| {
        pairs.iter().filter(move |(name, _)| name == wanted).map(|(_, value)| value.clone())
    };
    let negatives: Vec<String> = of("negative").collect();
    if negatives.len() > MAX_NEGATIVES {
        return Err(bad(format!("{} negatives, expected at most {MAX_NEGATIVES}", negatives.len())));
    }
    let text = of("text").next().filter(|text| !text.trim().is_empty());
    Ok((text.ok_or_else(|| bad("text is missing: say what to look for"))?, negatives))
}
