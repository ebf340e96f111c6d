//! `GET /v1/view` and below: what the page needs to draw the scene and to colour it by a question.

use std::sync::Arc;

use axum::Json;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use slag_service::problem::Problem;
use slag_service::replies::{As, Binary};
use slag_service::routes::Parameter;
use slag_view::{Description, Step, Words};

use super::body;
use super::params::{self, Pairs, number};
use crate::http::app::App;
use crate::http::forms;
use crate::http::problem::{parameter_problem, query_problem};
use crate::query::{Negatives, QueryError, RequestError};
use crate::score::Budget;

/// Largest generation that a request can name: the largest integer that every client of JSON keeps.
const MAX_GENERATION: u64 = (1 << 53) - 1;

/// Returns the parameters of `/v1/view/scores`.
pub fn scores_parameters() -> [Parameter; 2] {
    [forms::text("mug", "what to look for").required(), params::negative()]
}

/// Returns the parameters of the query string of `/v1/view/cells/{id}`.
pub fn cell_parameters() -> [Parameter; 2] {
    [
        Parameter::new::<u64>(
            "generation",
            "12",
            "the generation that must be on board: 404 if another one is",
        )
        .within(0, MAX_GENERATION),
        Parameter::new::<usize>("step", "8", "sends every so many-th Gaussian, each larger; 1 sends all")
            .within(1, Step::MAX)
            .or(1),
    ]
}

pub async fn describe(State(app): State<Arc<App>>) -> Result<Json<Description>, Problem> {
    app.within_limits(None, |app, budget| {
        let posted = app.following.as_ref().and_then(|following| following.status().position);
        let described = app.engine.view(|snapshot| posted?.in_world(&snapshot.manifest).ok(), budget);
        described.map(Json).map_err(query_problem)
    })
    .await
}

pub async fn scores(
    State(app): State<Arc<App>>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<As<Binary>, Problem> {
    let (text, negatives) = parse_scores(&params::pairs(pairs)?).map_err(parameter_problem)?;
    message(&app, move |app, budget| Ok(Some(app.engine.view_scores(&text, negatives, budget)?))).await
}

pub async fn cell(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<As<Binary>, Problem> {
    let (cell_id, generation, step) = parse_cell(&id, &params::pairs(pairs)?).map_err(parameter_problem)?;
    message(&app, move |app, budget| app.engine.view_cell(cell_id, generation, step, budget)).await
}

pub async fn words(State(app): State<Arc<App>>) -> Result<Json<Words>, Problem> {
    app.within_limits(None, |app, budget| app.engine.view_words(budget).map(Json).map_err(query_problem))
        .await
}

/// Makes a message within the limits of a query.
async fn message(
    app: &Arc<App>,
    make: impl FnOnce(&App, &Budget) -> Result<Option<Vec<u8>>, QueryError> + Send + 'static,
) -> Result<As<Binary>, Problem> {
    let making = app.within_limits(None, move |app, budget| {
        let made = make(app, budget).map_err(query_problem)?;
        made.ok_or_else(|| {
            let detail =
                "the cell is not on board, or of another generation; GET /v1/view lists those that are";
            Problem::new(StatusCode::NOT_FOUND, "no-such-cell", "No such cell", detail)
        })
    });
    Ok(As::new(([(header::CONTENT_TYPE, "application/octet-stream")], making.await?)))
}

fn parse_scores(pairs: &[(String, String)]) -> Result<(String, Negatives), RequestError> {
    params::check_names(pairs, &scores_parameters())?;
    let of = |wanted: &'static str| {
        pairs.iter().filter(move |(name, _)| name == wanted).map(|(_, value)| value.clone())
    };
    let text = of("text").next();
    let text = text.ok_or_else(|| RequestError::new("text", "nothing", "words to look for"))?;
    Ok((text, body::negatives(of("negative").collect())))
}

fn parse_cell(id: &str, pairs: &[(String, String)]) -> Result<(u32, Option<u64>, Step), RequestError> {
    params::check_names(pairs, &cell_parameters())?;
    let cell_id = number("id", id, "a cell's id, a whole number")?;
    let of = |wanted: &str| pairs.iter().find(|(name, _)| name == wanted).map(|(_, value)| value);
    let generation = of("generation").map(|value| number("generation", value, "a whole number"));
    let step = of("step").map_or(Ok(Step::ALL), |value| {
        Step::parse(value).map_err(|expected| RequestError::new("step", value, expected))
    });
    Ok((cell_id, generation.transpose()?, step?))
}
