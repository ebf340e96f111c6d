//! `POST /position`: where the robot is.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::http::StatusCode;
use serde_json::{Value, json};
use slag_service::problem::Problem;

use super::app::App;
use super::problem::{not_following, parameter_problem};
use crate::fetch::NotAPosition;
use crate::fetch::Position;
use crate::query::RequestError;

/// Longest body; a position needs a tenth.
pub const MAX_BODY_BYTES: usize = 1024;
const EXPECTED: &str = r#"{"x":..,"y":..,"z":..} or {"lat":..,"lon":..,"height":..}"#;

pub async fn position(
    State(app): State<Arc<App>>,
    body: Result<Bytes, BytesRejection>,
) -> Result<(StatusCode, Json<Value>), Problem> {
    let Some(following) = &app.following else { return Err(not_following()) };
    let refused = |found: &str| parameter_problem(RequestError::new("body", found, EXPECTED));
    let body = body.map_err(|e| refused(&e.body_text()))?;
    let text = String::from_utf8_lossy(&body);
    let position: Position = text.parse().map_err(|e: NotAPosition| refused(&e.found))?;
    following.post(position);
    Ok((StatusCode::ACCEPTED, Json(json!({ "position": position }))))
}
