//! `POST /position`: where the robot is.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde_json::json;

use super::{App, Problem};
use crate::fetch::NotAPosition;
use crate::fetch::Position;
use crate::query::RequestError;

/// A longer body is refused: no position needs as much.
pub const MAX_BODY_BYTES: usize = 1024;
const EXPECTED: &str = r#"{"x":..,"y":..,"z":..} or {"lat":..,"lon":..,"height":..}"#;

pub async fn position(
    State(app): State<Arc<App>>,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    let Some(following) = &app.following else {
        let detail = "positions are not followed; start the service with --follow URL";
        return Err(Problem::new(StatusCode::CONFLICT, "not-following", "Not following", detail));
    };
    let body = body.map_err(|e| RequestError::new("body", &e.body_text(), EXPECTED))?;
    let text = String::from_utf8_lossy(&body);
    let position: Position =
        text.parse().map_err(|e: NotAPosition| RequestError::new("body", &e.found, EXPECTED))?;
    following.post(position);
    Ok((StatusCode::ACCEPTED, Json(json!({ "position": position }))).into_response())
}
