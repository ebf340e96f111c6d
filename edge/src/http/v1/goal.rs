//! `GET /v1/goal`: places to stand near a thing. `GET /v1/floor`: the ground around the robot.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use schemars::JsonSchema;
use serde::Deserialize;
use slag_api::FRAME;
use slag_api::floor::{Floor, runs_of};
use slag_api::goal::GoalReply;
use slag_service::params::Params;
use slag_service::problem::Problem;

use crate::goal::request::{
    HEIGHT_M, MAX_POSES, MIN_VISIBLE, RADIUS_M, RANGE_M, REACH_M, SENSOR_HEIGHT_M, SLOPE, STEP_M,
};
use crate::goal::{self, GoalError, GoalRequest, GoalTarget};
use crate::http::app::App;
use crate::http::forms::{self, LatLonText, ObjectIdText, XyzText};
use crate::http::problem::query_problem;
use crate::query::{Point, RequestError, Words};
use crate::score::Budget;

/// The thing to go to, and how near.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct GoalParams {
    /// The thing to go to; may name relations.
    #[schemars(with = "Option<Words>", example = &"chair")]
    text: Option<String>,
    /// The same by its id, instead of text.
    #[schemars(example = &"o0123456789abcdef")]
    id: Option<ObjectIdText>,
    /// Largest horizontal distance to the thing's surface.
    #[schemars(range(min = REACH_M[0], max = REACH_M[1]), extend("default" = usual().reach_m), example = 0.8)]
    reach_m: Option<f64>,
    /// Least share of the thing's Gaussians that the sensor must see.
    #[schemars(range(min = MIN_VISIBLE[0], max = MIN_VISIBLE[1]), extend("default" = usual().min_visible), example = 0.05)]
    min_visible: Option<f64>,
    /// Most poses.
    #[schemars(range(min = 1, max = MAX_POSES), extend("default" = usual().limit), example = 3)]
    limit: Option<usize>,
}

/// The robot: its place and its size.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct RobotParams {
    /// Where the robot is; by default its last position if it is followed, else the middle of the area on board.
    #[schemars(example = &"2,1.5,0")]
    near: Option<XyzText>,
    /// The same on the earth, WGS 84: lat,lon or lat,lon,height.
    #[schemars(example = &"46.8,-92.1")]
    near_lat_lon: Option<LatLonText>,
    /// Radius of the robot, seen from above.
    #[schemars(range(min = RADIUS_M[0], max = RADIUS_M[1]), extend("default" = usual().radius_m), example = 0.3)]
    radius_m: Option<f64>,
    /// Height of its sensor above the ground.
    #[schemars(
        range(min = SENSOR_HEIGHT_M[0], max = SENSOR_HEIGHT_M[1]),
        extend("default" = usual().sensor_height_m),
        example = 0.4
    )]
    sensor_height_m: Option<f64>,
    /// Height of the robot; by default 0.1 above the sensor.
    #[schemars(range(min = HEIGHT_M[0], max = HEIGHT_M[1]), example = 0.5)]
    height_m: Option<f64>,
    /// Highest step that it climbs, 1.5 of the scene's voxels or more; by default 0.1, or 0.15 with voxels of 0.1 m.
    #[schemars(range(min = STEP_M[0], max = STEP_M[1]), example = 0.1)]
    step_m: Option<f64>,
    /// Steepest ground that it drives on: rise for each metre of way.
    #[schemars(range(min = SLOPE[0], max = SLOPE[1]), extend("default" = usual().slope), example = 0.4)]
    slope: Option<f64>,
    /// How far around it ground is looked at.
    #[schemars(range(min = RANGE_M[0], max = RANGE_M[1]), extend("default" = usual().range_m), example = 20)]
    range_m: Option<f64>,
}

fn usual() -> GoalRequest {
    GoalRequest::new(GoalTarget::Text(String::new()))
}

impl RobotParams {
    /// Returns a request with this robot, and its place.
    fn request(self) -> Result<(GoalRequest, Option<Point>), RequestError> {
        let usual = usual();
        let request = GoalRequest {
            radius_m: self.radius_m.unwrap_or(usual.radius_m),
            sensor_height_m: self.sensor_height_m.unwrap_or(usual.sensor_height_m),
            height_m: self.height_m,
            step_m: self.step_m,
            slope: self.slope.unwrap_or(usual.slope),
            range_m: self.range_m.unwrap_or(usual.range_m),
            ..usual
        };
        Ok((request, forms::point(self.near, self.near_lat_lon)?))
    }
}

pub async fn goal(
    State(app): State<Arc<App>>,
    Params((of_goal, robot)): Params<(GoalParams, RobotParams)>,
) -> Result<Json<GoalReply>, Problem> {
    let (mut request, near) = robot.request()?;
    request.target = match (of_goal.text, of_goal.id) {
        (Some(text), None) if !text.trim().is_empty() => GoalTarget::Text(text),
        (None, Some(ObjectIdText(id))) => GoalTarget::Object(id),
        (Some(_), Some(_)) => return Err(RequestError::new("id", "text as well", "one of the two").into()),
        _ => return Err(RequestError::new("text", "nothing", "the thing to go to, or its id as id").into()),
    };
    request.reach_m = of_goal.reach_m.unwrap_or(request.reach_m);
    request.min_visible = of_goal.min_visible.unwrap_or(request.min_visible);
    request.limit = of_goal.limit.unwrap_or(request.limit);
    answer(&app, near, request, |app, request, budget| goal::find(&app.engine, request, budget)).await
}

pub async fn floor(
    State(app): State<Arc<App>>,
    Params(robot): Params<RobotParams>,
) -> Result<Json<Floor>, Problem> {
    let (request, near) = robot.request()?;
    answer(&app, near, request, |app, request, budget| {
        let generation = app.engine.snapshot()?.manifest.generation;
        let map = goal::floor_map(&app.engine, request, budget)?;
        Ok(Floor {
            generation,
            frame: FRAME.into(),
            cell_m: map.cell_m,
            origin_in_world: map.origin_in_world,
            size: map.size,
            runs: runs_of(&map.places),
        })
    })
    .await
}

async fn answer<T: Send + 'static>(
    app: &Arc<App>,
    near: Option<Point>,
    mut request: GoalRequest,
    work: impl FnOnce(&App, &GoalRequest, &Budget) -> Result<T, GoalError> + Send + 'static,
) -> Result<Json<T>, Problem> {
    request.check()?;
    let answering = app.within_limits(None, move |app, budget| {
        let snapshot = app.engine.snapshot().map_err(query_problem)?;
        request.near = match near {
            Some(near) => Some(near.in_world("near", &snapshot.manifest)?),
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
