//! `GET /v1/metadata/{name}` and `GET /v1/targets/{name}`: the store for clients of The Update Framework.

use axum::Json;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path as UrlPath, State};
use axum::http::header;
use slag_common::tuf::Envelope;
use slag_service::problem::Problem;
use slag_service::replies::{As, Binary};

use super::problem;
use super::state::AppState;
use crate::store::metadata::{TIMESTAMP_FILE, read_published};

type Name = Result<UrlPath<String>, PathRejection>;

pub(super) async fn metadata(State(service): AppState, name: Name) -> Result<As<Json<Envelope>>, Problem> {
    let UrlPath(name) = name.map_err(|e| problem::bad_parameter(e.body_text()))?;
    // All but the timestamp never change.
    let lasting = if name == TIMESTAMP_FILE { "no-cache" } else { "public, max-age=31536000, immutable" };
    let read = service.with_current(move |snapshot| {
        let read = read_published(snapshot.reader.dir(), &name).map_err(Problem::internal)?;
        read.ok_or_else(|| problem::not_published(&format!("metadata {name}")))
    });
    let about = [(header::CONTENT_TYPE, "application/json"), (header::CACHE_CONTROL, lasting)];
    Ok(As::new((about, read.await?)))
}

pub(super) async fn target(State(service): AppState, name: Name) -> Result<As<Binary>, Problem> {
    let UrlPath(name) = name.map_err(|e| problem::bad_parameter(e.body_text()))?;
    let found = service.with_current(move |snapshot| {
        let target = snapshot.targets.get(&name).cloned();
        target.ok_or_else(|| problem::not_published(&format!("target {name}")))
    });
    Ok(As::new(([(header::CONTENT_TYPE, "application/octet-stream")], found.await?)))
}
