//! `GET /v1/goal`: places to stand near a thing. `GET /v1/floor`: the ground around the robot.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::extract::rejection::QueryRejection;
use axum::http::StatusCode;
use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;
use slag_service::problem::Problem;
use slag_service::routes::Parameter;

use super::params::{self, Pairs, lat_lon, number};
use crate::goal::{self, FloorMap, GoalError, GoalReply, GoalRequest, GoalTarget, Place, request};
use crate::http::app::App;
use crate::http::forms;
use crate::http::problem::{parameter_problem, query_problem};
use crate::query::{FRAME, Point, RequestError, object_id, parse_point};
use crate::score::Budget;

/// Returns the parameters of `/v1/goal`.
pub fn parameters() -> Vec<Parameter> {
    let usual = GoalRequest::new(GoalTarget::Text(String::new()));
    let of_goal = [
        forms::text("chair", "the thing to go to; may name relations"),
        forms::object_id("id", "the same by its id, instead of text"),
        length("reach_m", "0.8", "largest horizontal distance to the thing's surface", request::REACH_M)
            .or(usual.reach_m),
        Parameter::new::<f64>(
            "min_visible",
            "0.05",
            "least share of the thing's Gaussians that the sensor must see",
        )
        .within(request::MIN_VISIBLE[0], request::MIN_VISIBLE[1])
        .or(usual.min_visible),
        Parameter::new::<usize>("limit", "3", "most poses, at most 20")
            .within(1, request::MAX_POSES)
            .or(usual.limit),
    ];
    of_goal.into_iter().chain(floor_parameters()).collect()
}

/// Returns the parameters of `/v1/floor`.
pub fn floor_parameters() -> Vec<Parameter> {
    let usual = GoalRequest::new(GoalTarget::Text(String::new()));
    vec![
        forms::near(
            "where the robot is (default: its last position if it is followed, else the middle of the area on board)",
        ),
        forms::near_lat_lon(),
        length("radius_m", "0.3", "radius of the robot, seen from above", request::RADIUS_M)
            .or(usual.radius_m),
        length("sensor_height_m", "0.4", "height of its sensor above the ground", request::SENSOR_HEIGHT_M)
            .or(usual.sensor_height_m),
        length("height_m", "0.5", "height of the robot (default: 0.1 above the sensor)", request::HEIGHT_M),
        length(
            "step_m",
            "0.1",
            "highest step that it climbs, 1.5 of the scene's voxels or more (default: 0.1, or 0.15 with voxels of 0.1 m)",
            request::STEP_M,
        ),
        Parameter::new::<f64>(
            "slope",
            "0.4",
            "steepest ground that it drives on: rise for each metre of way",
        )
        .within(request::SLOPE[0], request::SLOPE[1])
        .or(usual.slope),
        length("range_m", "20", "how far around it ground is looked at", request::RANGE_M).or(usual.range_m),
    ]
}

fn length(name: &'static str, example: &'static str, summary: &str, [low, high]: [f64; 2]) -> Parameter {
    Parameter::new::<f64>(name, example, summary).within(low, high)
}

pub async fn goal(
    State(app): State<Arc<App>>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<Json<GoalReply>, Problem> {
    let pairs = params::pairs(pairs)?;
    params::check_names(&pairs, &parameters()).map_err(parameter_problem)?;
    let (request, near) = parse(&pairs).map_err(parameter_problem)?;
    let is_text = matches!(&request.target, GoalTarget::Text(text) if text.trim().is_empty());
    if is_text {
        let refused = RequestError::new("text", "nothing", "the thing to go to, or its id as id");
        return Err(parameter_problem(refused));
    }
    answer(&app, near, request, |app, request, budget| goal::find(&app.engine, request, budget)).await
}

pub async fn floor(
    State(app): State<Arc<App>>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<Json<Floor>, Problem> {
    let pairs = params::pairs(pairs)?;
    params::check_names(&pairs, &floor_parameters()).map_err(parameter_problem)?;
    let (request, near) = parse(&pairs).map_err(parameter_problem)?;
    answer(&app, near, request, |app, request, budget| {
        let generation = app.engine.snapshot()?.manifest.generation;
        Ok(Floor::new(generation, &goal::floor_map(&app.engine, request, budget)?))
    })
    .await
}

async fn answer<T: Send + 'static>(
    app: &Arc<App>,
    near: Option<Point>,
    mut request: GoalRequest,
    work: impl FnOnce(&App, &GoalRequest, &Budget) -> Result<T, GoalError> + Send + 'static,
) -> Result<Json<T>, Problem> {
    let answering = app.within_limits(None, move |app, budget| {
        let snapshot = app.engine.snapshot().map_err(query_problem)?;
        let in_world = |near: Point| near.in_world("near", &snapshot.manifest);
        request.near = match near {
            Some(near) => Some(in_world(near).map_err(parameter_problem)?),
            None => app.last_position(&snapshot.manifest),
        };
        work(app, &request, budget).map(Json).map_err(problem)
    });
    answering.await
}

fn problem(error: GoalError) -> Problem {
    let kind = error.kind();
    match error {
        GoalError::Query(error) => query_problem(error),
        error => Problem::new(StatusCode::CONFLICT, kind, "No places known", error.to_string()),
    }
}

/// The ground around the robot, in square cells.
#[derive(Serialize, JsonSchema)]
pub struct Floor {
    /// Generation that answers.
    generation: u64,
    /// Frame of every position: the scene's world frame.
    #[schemars(extend("enum" = [FRAME]))]
    frame: &'static str,
    /// Edge of a cell.
    cell_m: f64,
    /// Corner of the first cell.
    #[schemars(with = "[f64; 3]")]
    origin_in_world: DVec3,
    /// Cells along x and y.
    size: [usize; 2],
    /// A letter and a count for each run of equal cells, x first: u unknown, o obstacle, g ground, r ground that
    /// the robot reaches.
    runs: String,
}

impl Floor {
    fn new(generation: u64, map: &FloorMap) -> Self {
        let code = |place: &Place| match place {
            Place::Unknown => 'u',
            Place::Obstacle => 'o',
            Place::Ground => 'g',
            Place::Reached => 'r',
        };
        let runs = map.places.chunk_by(|a, b| a == b).map(|run| format!("{}{}", code(&run[0]), run.len()));
        Self {
            generation,
            frame: FRAME,
            cell_m: map.cell_m,
            origin_in_world: map.origin_in_world,
            size: map.size,
            runs: runs.collect(),
        }
    }
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
            "step_m" => request.step_m = Some(metres()?),
            "slope" => request.slope = metres()?,
            "range_m" => request.range_m = metres()?,
            "min_visible" => request.min_visible = metres()?,
            "limit" => request.limit = number(name, value, "a whole number")?,
            _ => {}
        }
    }
    request.check()?;
    Ok((request, near))
}
