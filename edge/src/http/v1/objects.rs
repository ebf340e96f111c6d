//! `GET /v1/objects` and `GET /v1/objects/{id}`: the things on board.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use schemars::JsonSchema;
use serde::Deserialize;
use slag_service::params::Params;
use slag_service::problem::Problem;

use crate::http::app::App;
use crate::http::forms::{self, ObjectIdText, XyzText};
use crate::http::problem::query_problem;
use crate::query::{ObjectFilter, ObjectOnBoard, ObjectPage, RequestError, object_id};
use crate::score::MAX_COORDINATE;

/// Objects in a page unless the request says otherwise.
const DEFAULT_PAGE: usize = 100;
/// Most objects in a page.
const MAX_PAGE: usize = 1000;

/// Which objects are listed.
#[derive(Deserialize, JsonSchema)]
pub struct ListParams {
    /// Objects in a page.
    #[serde(default = "default_page")]
    #[schemars(range(min = 1, max = MAX_PAGE), example = 100)]
    limit: usize,
    /// The id that the page begins after: next_after of the page before.
    #[schemars(example = &"o0123456789abcdef")]
    after: Option<ObjectIdText>,
    /// With radius: only objects with their position within this distance.
    #[schemars(example = &"2,1.5,0")]
    near: Option<XyzText>,
    /// With near, world units.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = MAX_COORDINATE), example = 5)]
    radius: Option<f64>,
    /// Least length of the box's longest edge, world units.
    #[serde(default)]
    #[schemars(range(min = 0), example = 0.5)]
    min_size: f64,
}

fn default_page() -> usize {
    DEFAULT_PAGE
}

impl ListParams {
    fn filter(self) -> Result<ObjectFilter, RequestError> {
        let refuse =
            |parameter, found: String, expected: String| Err(RequestError::new(parameter, &found, expected));
        if !(1..=MAX_PAGE).contains(&self.limit) {
            return refuse("limit", self.limit.to_string(), format!("1 to {MAX_PAGE}"));
        }
        if !(self.min_size >= 0.0 && self.min_size.is_finite()) {
            return refuse("min_size", self.min_size.to_string(), "0 or more".into());
        }
        Ok(ObjectFilter {
            after: self.after.map(|ObjectIdText(id)| id),
            ball: forms::ball(self.near.map(|XyzText(near)| near), self.radius)?,
            min_size: self.min_size,
        })
    }
}

pub async fn list(
    State(app): State<Arc<App>>,
    Params(params): Params<ListParams>,
) -> Result<Json<ObjectPage>, Problem> {
    let limit = params.limit;
    let filter = params.filter()?;
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
    let refused = || RequestError::new("id", &id, "o and 16 hex digits");
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
