//! `POST /position`: receives the robot's position.

use std::sync::Arc;

use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::http::StatusCode;
use schemars::{JsonSchema, SchemaGenerator};
use serde::Serialize;
use slag_service::problem::Problem;
use slag_service::replies::{As, Described, Reply};

use super::app::App;
use super::problem::{follower_failed, not_following};
use crate::fetch::{NotAPosition, Position};
use crate::query::RequestError;

/// Longest body; a position needs a tenth.
pub const MAX_BODY_BYTES: usize = 1024;
const EXPECTED: &str =
    r#"{"x":..,"y":..,"z":..} or {"lat":..,"lon":..,"height":..}, or as text `x y z` or `lat,lon[,height]`"#;

/// The position as the follower takes it.
#[derive(Serialize, JsonSchema)]
pub struct Accepted {
    /// The position.
    position: Position,
}

impl Described for Accepted {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        let ok = Reply::ok("application/json", schemas.subschema_for::<Self>());
        vec![Reply { status: StatusCode::ACCEPTED, ..ok }]
    }
}

pub async fn position(State(app): State<Arc<App>>, body: Bytes) -> Result<As<Accepted>, Problem> {
    let Some(following) = &app.following else { return Err(not_following()) };
    let text = String::from_utf8_lossy(&body);
    let refused = |e: NotAPosition| RequestError::new("body", &e.found, EXPECTED);
    let position: Position = text.parse().map_err(refused)?;
    // Before the first fetch no scene tells.
    if let (Position::Geographic { .. }, Ok(snapshot)) = (position, app.engine.snapshot())
        && snapshot.manifest.geo_reference.is_none()
    {
        let expected = r#"x, y, z in the world frame, as {"x":..,"y":..,"z":..} or `x y z`, since the scene has no geo-reference"#;
        return Err(RequestError::new("body", &text, expected).into());
    }
    // Kept even while nobody follows: the next follower starts from it.
    following.post(position);
    match following.failure() {
        Some(failure) => Err(follower_failed(&failure)),
        None => Ok(As::new((StatusCode::ACCEPTED, Json(Accepted { position })))),
    }
}
