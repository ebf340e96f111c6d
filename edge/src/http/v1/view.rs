//! `GET /v1/view` and below: data for the page that draws the scene and colours it by a question.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use schemars::JsonSchema;
use serde::Deserialize;
use slag_service::params::{Params, PathText};
use slag_service::problem::Problem;
use slag_service::replies::{As, Binary};
use slag_view::{Description, Step};

use crate::http::app::App;
use crate::query::{MAX_NEGATIVES, QueryError, RequestError, Words};
use crate::score::Budget;

/// Largest generation in a request: the largest integer that every JSON client keeps.
const MAX_GENERATION: u64 = (1 << 53) - 1;

/// The question that the scene is coloured by.
#[derive(Deserialize, JsonSchema)]
pub struct ScoresParams {
    /// What to look for.
    #[schemars(with = "Words", example = &"mug")]
    text: String,
    /// A negative prompt, commas included; may be repeated; or canonical alone: object, things, stuff, texture.
    #[serde(default)]
    #[schemars(with = "Vec<Words>", length(max = MAX_NEGATIVES), example = ["wall, floor"])]
    negative: Vec<String>,
}

/// Which Gaussians of a cell are sent.
#[derive(Deserialize, JsonSchema)]
pub struct CellParams {
    /// The generation that must be on board: 404 if another one is.
    #[schemars(range(min = 0, max = MAX_GENERATION), example = 12)]
    generation: Option<u64>,
    /// Sends every so many-th Gaussian, each larger; 1 sends all.
    #[schemars(with = "Option<usize>", range(min = 1, max = Step::MAX), extend("default" = 1), example = 8)]
    step: Option<String>,
}

pub async fn describe(State(app): State<Arc<App>>) -> Result<Json<Description>, Problem> {
    app.within_limits(None, |app, budget| {
        Ok(Json(app.engine.view(|snapshot| app.last_position(&snapshot.manifest), budget)?))
    })
    .await
}

pub async fn scores(
    State(app): State<Arc<App>>,
    Params(params): Params<ScoresParams>,
) -> Result<As<Binary>, Problem> {
    let ScoresParams { text, negative } = params;
    message(&app, move |app, budget| Ok(Some(app.engine.view_scores(text, negative.into(), budget)?))).await
}

pub async fn cell(
    State(app): State<Arc<App>>,
    PathText(id): PathText,
    Params(CellParams { generation, step }): Params<CellParams>,
) -> Result<As<Binary>, Problem> {
    let cell_id =
        id.parse::<u32>().map_err(|_| RequestError::new("id", &id, "a cell's id, a whole number"))?;
    let step = step.map_or(Ok(Step::ALL), |value| {
        Step::parse(&value).map_err(|expected| RequestError::new("step", &value, expected))
    })?;
    message(&app, move |app, budget| app.engine.view_cell(cell_id, generation, step, budget)).await
}

pub async fn words(State(app): State<Arc<App>>) -> Result<Json<slag_view::Words>, Problem> {
    app.within_limits(None, |app, budget| Ok(Json(app.engine.view_words(budget)?))).await
}

async fn message(
    app: &Arc<App>,
    make: impl FnOnce(&App, &Budget) -> Result<Option<Vec<u8>>, QueryError> + Send + 'static,
) -> Result<As<Binary>, Problem> {
    let making = app.within_limits(None, move |app, budget| {
        make(app, budget)?.ok_or_else(|| {
            let detail =
                "the cell is not on board, or of another generation; GET /v1/view lists those that are";
            Problem::new(StatusCode::NOT_FOUND, "no-such-cell", "No such cell", detail)
        })
    });
    Ok(As::new(([(header::CONTENT_TYPE, "application/octet-stream")], making.await?)))
}
