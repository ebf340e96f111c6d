//! `GET /v1/view/scores` and `GET /v1/view/cells/{id}`: what a page needs to draw the scene and colour it by a question.

use std::sync::Arc;

use axum::extract::rejection::QueryRejection;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use slag_service::problem::Problem;
use slag_service::routes::Parameter;

use super::body;
use super::params::{self, Pairs, number};
use crate::http::app::App;
use crate::http::problem::{overloaded, parameter_problem, query_problem, timeout};
use crate::query::{Negatives, QueryError, RequestError};
use crate::score::Budget;

/// Returns the parameters of `/v1/view/scores`.
pub fn scores_parameters() -> [Parameter; 2] {
    let parameter = |name, example, summary: &str| Parameter { name, example, summary: summary.to_owned() };
    [
        parameter("text", "mug", "what to look for"),
        parameter("negative", "wall", "a negative prompt, commas included; may be repeated; or canonical"),
    ]
}

pub async fn scores(
    State(app): State<Arc<App>>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<Response, Problem> {
    let (text, negatives) = parse(&params::pairs(pairs)?).map_err(parameter_problem)?;
    message(&app, move |app, budget| Ok(Some(app.engine.view_scores(&text, negatives, budget)?))).await
}

pub async fn cell(State(app): State<Arc<App>>, Path(id): Path<String>) -> Result<Response, Problem> {
    let cell_id: u32 = number("id", &id, "a cell's id, a whole number").map_err(parameter_problem)?;
    message(&app, move |app, budget| app.engine.view_positions(cell_id, budget)).await
}

/// Makes a message within the limits of a query.
async fn message(
    app: &Arc<App>,
    make: impl FnOnce(&App, &Budget) -> Result<Option<Vec<u8>>, QueryError> + Send + 'static,
) -> Result<Response, Problem> {
    let permit =
        Arc::clone(&app.permits).try_acquire_owned().map_err(|_| overloaded(app.settings.max_queries))?;
    let making = app.blocking(move |app| {
        // Held until the work is done, even if the client has given up.
        let _permit = permit;
        app.reload_if_stale();
        let made = make(app, &app.query_budget()).map_err(query_problem)?;
        made.ok_or_else(|| {
            let detail = "the cell is not on board; GET /v1/map lists those that are";
            Problem::new(StatusCode::NOT_FOUND, "no-such-cell", "No such cell", detail)
        })
    });
    let limit = app.settings.query_timeout;
    let bytes = tokio::time::timeout(limit, making).await.map_err(|_| timeout(limit))??;
    Ok(([(header::CONTENT_TYPE, "application/octet-stream")], bytes).into_response())
}

fn parse(pairs: &[(String, String)]) -> Result<(String, Negatives), RequestError> {
    params::check_names(pairs, &scores_parameters(), &["negative"])?;
    let of = |name: &str| pairs.iter().filter(move |(key, _)| key == name).map(|(_, value)| value.clone());
    let text = of("text").next();
    let text = text.ok_or_else(|| RequestError::new("text", "nothing", "words to look for"))?;
    Ok((text, body::negatives(of("negative").collect())))
}
