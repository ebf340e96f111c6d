//! `GET /status`, `GET /readyz` and `GET /metrics`.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use schemars::JsonSchema;
use serde::Serialize;
use slag_service::metrics::Exposition;
use slag_service::problem::Problem;

use super::app::App;
use super::problem::follower_failed;
use crate::fetch::accepted;
use crate::fetch::follow::FollowStatus;
use crate::query::Status;
use crate::text::EncoderInfo;

/// State of the service.
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "Status")]
pub struct ServiceStatus {
    /// Version of the program.
    version: &'static str,
    /// Whether queries are answered.
    is_ready: bool,
    /// Why not.
    error: Option<String>,
    /// The text encoder.
    text_model: EncoderInfo,
    /// The scene on board.
    scene: Option<Status>,
    /// The only scene that the robot accepts; null before the first fetch, or if its records are damaged.
    pinned_scene: Option<String>,
    /// When the newest timestamp of the store expires.
    expires_unix_secs: Option<u64>,
    /// Whether the store's newest timestamp has expired, so that there may be news; the scene still answers.
    is_expired: bool,
    /// How the robot is followed, if it is.
    following: Option<FollowStatus>,
}

pub async fn ready(State(app): State<Arc<App>>) -> Result<&'static str, Problem> {
    app.blocking(|app| {
        app.reload_if_stale();
        let on_board = app.engine.on_board()?;
        on_board.check()?;
        if !on_board.text_is_alive() {
            return Err(Problem::internal("the text model has stopped"));
        }
        match app.following.as_ref().and_then(|following| following.failure()) {
            Some(failure) => Err(follower_failed(&failure)),
            None => Ok("ready\n"),
        }
    })
    .await
}

pub async fn status(State(app): State<Arc<App>>) -> Result<Json<ServiceStatus>, Problem> {
    app.blocking(|app| {
        app.reload_if_stale();
        let on_board = app.engine.on_board();
        let error = on_board
            .as_ref()
            .map_or_else(|e| Some(e.to_string()), |on_board| on_board.check().err().map(|e| e.to_string()));
        let accepted = accepted(app.engine.cache()).ok().flatten();
        let expires_unix_secs = accepted.as_ref().and_then(|accepted| accepted.expires_unix_secs);
        // An expired scene still answers: an old map is better than none, if the client can tell.
        let is_expired = expires_unix_secs.is_some_and(|expires| expires <= crate::now_unix_secs());
        Ok(Json(ServiceStatus {
            version: env!("CARGO_PKG_VERSION"),
            is_ready: error.is_none() && on_board.as_ref().is_ok_and(|on_board| on_board.text_is_alive()),
            error,
            text_model: app.engine.encoder(),
            scene: on_board.as_ref().ok().map(|on_board| Status::of(&on_board.snapshot)),
            pinned_scene: accepted.and_then(|accepted| accepted.scene),
            expires_unix_secs,
            is_expired,
            following: app.following.as_ref().map(|following| following.status()),
        }))
    })
    .await
}

pub async fn metrics(State(app): State<Arc<App>>) -> Exposition {
    let n_in_progress = app.settings.max_queries - app.permits.available_permits();
    let following = app.following.as_ref().map(|following| following.status());
    app.metrics.render(n_in_progress, app.engine.snapshot().ok().as_deref(), following.as_ref())
}
