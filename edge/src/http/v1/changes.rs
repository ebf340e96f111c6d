//! `GET /v1/changes`: what changed between two generations that the robot has had.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use schemars::JsonSchema;
use serde::Deserialize;
use slag_api::changes::ChangesReply;
use slag_service::params::Params;
use slag_service::problem::Problem;

use crate::http::app::App;
use crate::http::forms::BallParams;
use crate::query::{ChangesRequest, MAX_TEXTS, RequestError, Words};

/// Which changes are asked for.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct ChangesParams {
    /// The earlier generation; by default the newest before the later one that is remembered.
    #[schemars(example = 3)]
    from: Option<u64>,
    /// The later generation; by default that on board.
    #[schemars(example = 4)]
    to: Option<u64>,
    /// A kind of thing: each thing names the one it is most like; may be repeated.
    #[serde(default)]
    #[schemars(with = "Vec<Words>", length(max = MAX_TEXTS), example = ["chair"])]
    text: Vec<String>,
}

pub async fn changes(
    State(app): State<Arc<App>>,
    Params((params, ball)): Params<(ChangesParams, BallParams)>,
) -> Result<Json<ChangesReply>, Problem> {
    let ChangesParams { from, to, text: texts } = params;
    if texts.len() > MAX_TEXTS {
        let (found, expected) = (texts.len().to_string(), format!("at most {MAX_TEXTS} texts"));
        return Err(RequestError::new("text", &found, expected).into());
    }
    let ball = ball.ball()?;
    let answering = app.within_limits(None, move |app, budget| {
        let snapshot = app.engine.snapshot()?;
        let ball = match ball {
            Some((near, radius)) => Some((near.in_world("near", &snapshot.manifest)?, radius)),
            None => None,
        };
        Ok(Json(app.engine.changes(&ChangesRequest { from, to, ball, texts }, budget)?))
    });
    answering.await
}
