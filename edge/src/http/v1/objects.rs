//! `GET /v1/objects` and `GET /v1/objects/{id}`: the things on board.

use std::sync::Arc;

use axum::Json;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use slag_service::problem::Problem;
use slag_service::routes::Parameter;

use super::params::{self, Pairs, number};
use crate::http::app::App;
use crate::http::forms;
use crate::http::problem::{parameter_problem, query_problem};
use crate::query::{ObjectFilter, ObjectOnBoard, ObjectPage, RequestError, object_id, parse_point};

/// Objects in a page unless the request says otherwise.
const DEFAULT_PAGE: usize = 100;
/// Most objects in a page.
const MAX_PAGE: usize = 1000;

/// Returns the parameters of `/v1/objects`.
pub fn parameters() -> [Parameter; 5] {
    [
        Parameter::new::<usize>("limit", "100", "objects in a page, at most 1000")
            .within(1, MAX_PAGE)
            .or(DEFAULT_PAGE),
        forms::object_id("after", "the id that the page begins after: next_after of the page before"),
        forms::near("with radius: only objects with their position within this distance"),
        forms::length("radius", "r", "with near"),
        Parameter::new::<f64>("min_size", "0.5", "least length of the box's longest edge, world units")
            .limit("minimum", 0),
    ]
}

pub async fn list(
    State(app): State<Arc<App>>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<Json<ObjectPage>, Problem> {
    let (filter, limit) = parse(&params::pairs(pairs)?).map_err(parameter_problem)?;
    app.within_limits(None, move |app, budget| {
        let snapshot = app.engine.snapshot().map_err(query_problem)?;
        app.engine.objects(&snapshot, &filter, limit, budget).map(Json).map_err(query_problem)
    })
    .await
}

pub async fn one(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
) -> Result<Json<ObjectOnBoard>, Problem> {
    let refused = || parameter_problem(RequestError::new("id", &id, "o and 16 hex digits"));
    let wanted = object_id(&id).ok_or_else(refused)?;
    app.within_limits(None, move |app, budget| {
        let snapshot = app.engine.snapshot().map_err(query_problem)?;
        let found = app.engine.object(&snapshot, wanted, budget).map_err(query_problem)?;
        let Some(object) = found else {
            let detail = format!(
                "generation {} has no object {id} on board; GET /v1/objects lists those it has",
                snapshot.manifest.generation
            );
            return Err(Problem::new(StatusCode::NOT_FOUND, "no-such-object", "No such object", detail));
        };
        Ok(Json(object))
    })
    .await
}

fn parse(pairs: &[(String, String)]) -> Result<(ObjectFilter, usize), RequestError> {
    params::check_names(pairs, &parameters())?;
    let (mut filter, mut limit, mut near) = (ObjectFilter::default(), DEFAULT_PAGE, None);
    let mut radius = None;
    for (name, value) in pairs {
        let refused = |expected: String| RequestError::new(name, value, expected);
        match name.as_str() {
            "limit" => {
                limit = number(name, value, "a whole number")?;
                if !(1..=MAX_PAGE).contains(&limit) {
                    return Err(refused(format!("1 to {MAX_PAGE}")));
                }
            }
            "after" => {
                filter.after = Some(object_id(value).ok_or_else(|| refused("o and 16 hex digits".into()))?);
            }
            "near" => near = Some(parse_point(value).map_err(refused)?),
            "radius" => radius = Some(number::<f64>(name, value, "a number")?),
            "min_size" => {
                filter.min_size = number(name, value, "a number")?;
                if !(filter.min_size >= 0.0 && filter.min_size.is_finite()) {
                    return Err(refused("0 or more".into()));
                }
            }
            _ => {}
        }
    }
    filter.ball = match (near, radius) {
        (None, None) => None,
        (Some(near), Some(radius)) if radius > 0.0 && f64::is_finite(radius) => Some((near, radius)),
        (Some(_), Some(radius)) => {
            return Err(RequestError::new("radius", &radius.to_string(), "more than 0"));
        }
        (None, Some(_)) => {
            return Err(RequestError::new("near", "nothing", "x,y,z, because there is a radius"));
        }
        (Some(_), None) => {
            return Err(RequestError::new("radius", "nothing", "a number, because there is near"));
        }
    };
    Ok((filter, limit))
}
