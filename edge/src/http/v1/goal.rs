//! `GET /v1/goal`: places to stand near a thing. `GET /v1/floor`: the ground around the robot.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::extract::rejection::QueryRejection;
use axum::http::StatusCode;
use serde_json::{Value, json};
use slag_service::problem::Problem;
use slag_service::routes::Parameter;

use super::params::{self, Pairs, lat_lon, number};
use crate::goal::{self, FloorMap, GoalError, GoalRequest, GoalTarget, Place};
use crate::http::app::App;
use crate::http::problem::{overloaded, parameter_problem, query_problem, timeout};
use crate::query::{FRAME, Point, RequestError, object_id, parse_point};

/// Returns the parameters of `/v1/goal`.
pub fn parameters() -> Vec<Parameter> {
    let of_goal = [
        Parameter::new("text", "chair", "the thing to go to; may name relations"),
        Parameter::new("id", "o0123456789abcdef", "the same by its id, instead of text"),
        Parameter::new("reach_m", "0.8", "largest horizontal distance to the thing's surface (default: 0.8)"),
        Parameter::new(
            "min_visible",
            "0.05",
            "least share of the thing that the sensor must see (default: 0.05)",
        ),
        Parameter::new("limit", "3", "most poses (default: 3, at most 20)"),
    ];
    of_goal.into_iter().chain(floor_parameters()).collect()
}

/// Returns the parameters of `/v1/floor`.
pub fn floor_parameters() -> Vec<Parameter> {
    vec![
        Parameter::new(
            "near",
            "x,y,z",
            "where the robot is (default: its last position if it is followed, else the middle of the area on board)",
        ),
        Parameter::new("near_lat_lon", "lat,lon", "the same on the earth"),
        Parameter::new("radius_m", "0.3", "radius of the robot, seen from above (default: 0.3)"),
        Parameter::new("sensor_height_m", "0.4", "height of its sensor above the ground (default: 0.4)"),
        Parameter::new("height_m", "0.5", "height of the robot (default: 0.1 above the sensor)"),
        Parameter::new("step_m", "0.1", "highest step that it climbs (default: 0.1)"),
        Parameter::new("range_m", "20", "how far around it ground is looked at (default: 20)"),
    ]
}

pub async fn goal(
    State(app): State<Arc<App>>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<Json<Value>, Problem> {
    let pairs = params::pairs(pairs)?;
    params::check_names(&pairs, &parameters(), &[]).map_err(parameter_problem)?;
    let (request, near) = parse(&pairs).map_err(parameter_problem)?;
    let is_text = matches!(&request.target, GoalTarget::Text(text) if text.trim().is_empty());
    if is_text {
        let refused = RequestError::new("text", "nothing", "the thing to go to, or its id as id");
        return Err(parameter_problem(refused));
    }
    answer(&app, near, request, |app, request| {
        let reply = goal::find(&app.engine, request, &app.query_budget())?;
        Ok(json!(reply))
    })
    .await
}

pub async fn floor(
    State(app): State<Arc<App>>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<Json<Value>, Problem> {
    let pairs = params::pairs(pairs)?;
    params::check_names(&pairs, &floor_parameters(), &[]).map_err(parameter_problem)?;
    let (request, near) = parse(&pairs).map_err(parameter_problem)?;
    answer(&app, near, request, |app, request| {
        let generation = app.engine.snapshot()?.manifest.generation;
        Ok(described(generation, &goal::floor_map(&app.engine, request)?))
    })
    .await
}

async fn answer(
    app: &Arc<App>,
    near: Option<Point>,
    mut request: GoalRequest,
    work: impl FnOnce(&App, &GoalRequest) -> Result<Value, GoalError> + Send + 'static,
) -> Result<Json<Value>, Problem> {
    let limit = app.settings.query_timeout;
    let permit =
        Arc::clone(&app.permits).try_acquire_owned().map_err(|_| overloaded(app.settings.max_queries))?;
    let answering = app.blocking(move |app| {
        let _permit = permit;
        app.reload_if_stale();
        let snapshot = app.engine.snapshot().map_err(query_problem)?;
        let in_world = |near: Point| near.in_world("near", &snapshot.manifest);
        request.near = match near {
            Some(near) => Some(in_world(near).map_err(parameter_problem)?),
            None => app.last_position(&snapshot.manifest),
        };
        work(app, &request).map(Json).map_err(problem)
    });
    tokio::time::timeout(limit, answering).await.map_err(|_| timeout(limit))?
}

fn problem(error: GoalError) -> Problem {
    let kind = error.kind();
    match error {
        GoalError::Query(error) => query_problem(error),
        error => Problem::new(StatusCode::CONFLICT, kind, "No places known", error.to_string()),
    }
}

/// Describes a map: cells as runs of equal ones, x first.
fn described(generation: u64, map: &FloorMap) -> Value {
    let runs: Vec<(Place, usize)> =
        map.places.chunk_by(|a, b| a == b).map(|run| (run[0], run.len())).collect();
    let code = |place: &Place| match place {
        Place::Unknown => 'u',
        Place::Obstacle => 'o',
        Place::Ground => 'g',
        Place::Reached => 'r',
    };
    let text: String = runs.iter().map(|(place, n)| format!("{}{n}", code(place))).collect();
    json!({
        "generation": generation, "frame": FRAME, "cell_m": map.cell_m, "origin_in_world": map.origin_in_world,
        "size": map.size, "runs": text,
    })
}

/// Reads the parameters that both have; names were checked before.
fn parse(pairs: &[(String, String)]) -> Result<(GoalRequest, Option<Point>), RequestError> {
    let mut request = GoalRequest::new(GoalTarget::Text(String::new()));
    let mut near = None;
    for (name, value) in pairs {
        let refused = |expected: String| RequestError::new(name, value, expected);
        let metres = || number::<f64>(name, value, "a number");
        match name.as_str() {
            "text" => request.target = GoalTarget::Text(value.clone()),
            "id" => {
                let id = object_id(value).ok_or_else(|| refused("o and 16 hex digits".into()))?;
                request.target = GoalTarget::Object(id);
            }
            "near" => near = Some(Point::World(parse_point(value).map_err(refused)?.to_array())),
            "near_lat_lon" => near = Some(Point::Geographic(lat_lon(name, value)?)),
            "radius_m" => request.radius_m = metres()?,
            "reach_m" => request.reach_m = metres()?,
            "sensor_height_m" => request.sensor_height_m = metres()?,
            "height_m" => request.height_m = Some(metres()?),
            "step_m" => request.step_m = metres()?,
            "range_m" => request.range_m = metres()?,
            "min_visible" => request.min_visible = metres()?,
            "limit" => request.limit = number(name, value, "a whole number")?,
            _ => {}
        }
    }
    request.check()?;
    Ok((request, near))
}
