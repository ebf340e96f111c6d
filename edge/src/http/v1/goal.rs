//! `GET /v1/goal`: places to stand near a thing. `GET /v1/floor`: the ground around the robot.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use schemars::JsonSchema;
use serde::Deserialize;
use slag_api::FRAME;
use slag_api::floor::{Floor, runs_of};
use slag_api::goal::GoalReply;
use slag_service::params::Params;
use slag_service::problem::Problem;

use crate::goal::{self, GoalRequest, GoalTarget, Robot, Stand};
use crate::http::app::App;
use crate::http::forms::{self, LatLonText, ObjectIdText, XyzText};
use crate::query::{OnBoard, QueryError, RequestError, Words};
use crate::score::Budget;

#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct TargetParams {
    /// The thing to go to; may name relations.
    #[schemars(with = "Option<Words>", example = &"chair")]
    text: Option<String>,
    /// The same by its id, instead of text.
    #[schemars(example = &"o0123456789abcdef")]
    id: Option<ObjectIdText>,
    /// Where the robot looks, radians from the world's x axis towards y, for texts such as "chair left of me".
    #[schemars(example = 0.0)]
    heading_rad: Option<f64>,
}

#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct PlaceParams {
    /// Where the robot is; by default its last position if it is followed, else the middle of the area on board.
    #[schemars(example = &"2,1.5,0")]
    near: Option<XyzText>,
    /// The same on the earth, WGS 84: lat,lon or lat,lon,height.
    #[schemars(example = &"46.8,-92.1")]
    near_lat_lon: Option<LatLonText>,
}

pub async fn goal(
    State(app): State<Arc<App>>,
    Params((of, stand, place, robot)): Params<(TargetParams, Stand, PlaceParams, Robot)>,
) -> Result<Json<GoalReply>, Problem> {
    let target = match (of.text, of.id) {
        (Some(text), None) if !text.trim().is_empty() => GoalTarget::Text(text),
        (None, Some(ObjectIdText(id))) => GoalTarget::Object(id),
        (Some(_), Some(_)) => return Err(RequestError::new("id", "text as well", "one of the two").into()),
        _ => return Err(RequestError::new("text", "nothing", "the thing to go to, or its id as id").into()),
    };
    let request = GoalRequest { target, near: None, heading_rad: of.heading_rad, robot, stand };
    answer(&app, place, request, goal::find).await
}

pub async fn floor(
    State(app): State<Arc<App>>,
    Params((place, robot)): Params<(PlaceParams, Robot)>,
) -> Result<Json<Floor>, Problem> {
    let request = GoalRequest { robot, ..GoalRequest::new(GoalTarget::Text(String::new())) };
    answer(&app, place, request, |on_board, request, budget| {
        let map = goal::floor_map(&on_board.snapshot, request, budget)?;
        Ok(Floor {
            generation: on_board.snapshot.manifest.generation,
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
    place: PlaceParams,
    mut request: GoalRequest,
    work: impl FnOnce(&OnBoard, &GoalRequest, &Budget) -> Result<T, QueryError> + Send + 'static,
) -> Result<Json<T>, Problem> {
    let near = forms::point(place.near, place.near_lat_lon)?;
    request.check()?;
    let answering = app.within_limits(None, move |app, budget| {
        let on_board = app.engine.on_board()?;
        let manifest = &on_board.snapshot.manifest;
        request.near = match near {
            Some(near) => Some(near.in_world("near", manifest)?),
            None => app.last_position(manifest),
        };
        Ok(Json(work(&on_board, &request, budget)?))
    });
    answering.await
}
