//! `GET /v1/changes`: what changed between two generations that the robot has had.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::extract::rejection::QueryRejection;
use axum::http::StatusCode;
use slag_service::problem::Problem;
use slag_service::routes::Parameter;

use super::params::{self, Pairs, lat_lon, number};
use crate::http::app::App;
use crate::http::forms;
use crate::http::problem::{parameter_problem, query_problem};
use crate::query::{ChangesError, ChangesReply, ChangesRequest, MAX_TEXTS, Point, RequestError, parse_point};

/// Returns the parameters of `/v1/changes`.
pub fn parameters() -> [Parameter; 6] {
    [
        Parameter::new::<u64>(
            "from",
            "3",
            "the earlier generation (default: the newest before the later one that is remembered)",
        ),
        Parameter::new::<u64>("to", "4", "the later generation (default: that on board)"),
        forms::near("with radius: only changes within this distance; of a move, one end counts"),
        forms::near_lat_lon(),
        forms::length("radius", "r", "with near"),
        forms::text("chair", "a kind of thing: each thing names the one it is most like; may be repeated")
            .repeated(MAX_TEXTS),
    ]
}

pub async fn changes(
    State(app): State<Arc<App>>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<Json<ChangesReply>, Problem> {
    let (mut request, near, radius) = parse(&params::pairs(pairs)?).map_err(parameter_problem)?;
    let answering = app.within_limits(None, move |app, budget| {
        let snapshot = app.engine.snapshot().map_err(query_problem)?;
        let near = near.map(|near| near.in_world("near", &snapshot.manifest)).transpose();
        request.ball = near.map_err(parameter_problem)?.zip(radius);
        app.engine.changes(&request, budget).map(Json).map_err(problem)
    });
    answering.await
}

fn problem(error: ChangesError) -> Problem {
    let (kind, detail) = (error.kind(), error.to_string());
    match error {
        ChangesError::Query(error) => query_problem(error),
        ChangesError::NoSuchGeneration { .. } => {
            Problem::new(StatusCode::NOT_FOUND, kind, "No such generation", detail)
        }
        ChangesError::Encoders { .. } | ChangesError::NoObjects(_) => {
            Problem::new(StatusCode::CONFLICT, kind, "Generations do not compare", detail)
        }
    }
}

type Parsed = (ChangesRequest, Option<Point>, Option<f64>);

fn parse(pairs: &[(String, String)]) -> Result<Parsed, RequestError> {
    params::check_names(pairs, &parameters())?;
    let (mut request, mut near, mut radius) = (ChangesRequest::default(), None, None);
    for (name, value) in pairs {
        let refused = |expected: String| RequestError::new(name, value, expected);
        match name.as_str() {
            "from" => request.from = Some(number(name, value, "a whole number")?),
            "to" => request.to = Some(number(name, value, "a whole number")?),
            "near" => near = Some(Point::World(parse_point(value).map_err(refused)?.to_array())),
            "near_lat_lon" => near = Some(Point::Geographic(lat_lon(name, value)?)),
            "radius" => {
                let given = number::<f64>(name, value, "a number")?;
                if !(given > 0.0 && given.is_finite()) {
                    return Err(refused("more than 0".into()));
                }
                radius = Some(given);
            }
            "text" => request.texts.push(value.clone()),
            _ => {}
        }
    }
    if request.texts.len() > MAX_TEXTS {
        let found = request.texts.len().to_string();
        return Err(RequestError::new("text", &found, format!("at most {MAX_TEXTS} texts")));
    }
    match (near, radius) {
        (Some(_), None) => Err(RequestError::new("radius", "nothing", "a number, because there is near")),
        (None, Some(_)) => Err(RequestError::new("near", "nothing", "x,y,z, because there is a radius")),
        _ => Ok((request, near, radius)),
    }
}
