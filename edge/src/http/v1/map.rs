//! `GET /v1/map`: what is on board, how old it is, and what is missing.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use slag_api::map::MapStatus;
use slag_service::problem::Problem;

use crate::fetch::accepted;
use crate::http::app::App;
use crate::http::problem::query_problem;
use crate::query::map_status;

pub async fn map(State(app): State<Arc<App>>) -> Result<Json<MapStatus>, Problem> {
    app.blocking(|app| {
        app.reload_if_stale();
        let snapshot = app.engine.snapshot().map_err(query_problem)?;
        let expires_unix_secs = accepted(app.engine.cache()).and_then(|accepted| accepted.expires_unix_secs);
        Ok(Json(map_status(&snapshot, crate::now_unix_secs(), expires_unix_secs)))
    })
    .await
}
