//! `GET /v1/objects` and `GET /v1/objects/{id}`: the things on board.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use schemars::{JsonSchema, SchemaGenerator};
use serde::Deserialize;
use slag_api::objects::{ObjectOnBoard, ObjectPage};
use slag_common::manifest::Manifest;
use slag_service::params::Params;
use slag_service::problem::Problem;
use slag_service::replies::{As, Binary, Described, Reply};

use crate::http::app::App;
use crate::http::forms::{AreaParams, BallParams, ObjectIdText};
use crate::http::problem::query_problem;
use crate::query::{Area, ListFormat, NAMES_WAIT, ObjectFilter, ObjectOrder, RequestError, object_id};

const DEFAULT_PAGE: usize = 100;
const MAX_PAGE: usize = 1000;

/// Which objects are listed.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct ListParams {
    /// Objects in a page.
    #[serde(default = "default_page")]
    #[schemars(range(min = 1, max = MAX_PAGE), example = 100)]
    limit: usize,
    /// The id that the page begins after: next_after of the page before, asked for in the same way.
    #[schemars(example = &"o0123456789abcdef")]
    after: Option<ObjectIdText>,
    /// Order of the objects: id, name (the best one), or area (of the box's largest face, the largest first).
    #[serde(default)]
    #[schemars(example = &"id")]
    sort: ObjectOrder,
    /// Least length of the box's longest edge, world units.
    #[serde(default)]
    #[schemars(range(min = 0), example = 0.5)]
    min_size: f64,
    /// json, csv (a line for each object), or geojson (a point for each, of scenes with a place on the earth).
    #[serde(default)]
    #[schemars(example = &"json")]
    format: ListFormat,
}

fn default_page() -> usize {
    DEFAULT_PAGE
}

impl ListParams {
    fn filter(self, area: Area, manifest: &Manifest) -> Result<ObjectFilter, RequestError> {
        let refuse =
            |parameter, found: String, expected: String| Err(RequestError::new(parameter, &found, expected));
        if !(1..=MAX_PAGE).contains(&self.limit) {
            return refuse("limit", self.limit.to_string(), format!("1 to {MAX_PAGE}"));
        }
        if !(self.min_size >= 0.0 && self.min_size.is_finite()) {
            return refuse("min_size", self.min_size.to_string(), "0 or more".into());
        }
        self.format.check(manifest)?;
        Ok(ObjectFilter {
            region: area.in_world(manifest)?,
            after: self.after.map(|ObjectIdText(id)| id),
            min_size: self.min_size,
            order: self.sort,
        })
    }
}

pub async fn list(
    State(app): State<Arc<App>>,
    Params((params, ball, area)): Params<(ListParams, BallParams, AreaParams)>,
) -> Result<As<ListFormats>, Problem> {
    let (limit, format, area) = (params.limit, params.format, area.area(ball.ball()?)?);
    let listing = app.within_limits(None, move |app, budget| {
        let on_board = app.engine.on_board().map_err(query_problem)?;
        let filter = params.filter(area, &on_board.snapshot.manifest)?;
        let page =
            app.engine.objects(&on_board, &filter, limit, NAMES_WAIT, budget).map_err(query_problem)?;
        format.write(&page).map_err(Problem::internal)
    });
    Ok(As::new(([(header::CONTENT_TYPE, format.media_type())], listing.await?)))
}

pub struct ListFormats;

impl Described for ListFormats {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        let content = vec![
            (ListFormat::Json.media_type(), schemas.subschema_for::<ObjectPage>()),
            (ListFormat::Csv.media_type(), schemas.subschema_for::<String>()),
            (ListFormat::Geojson.media_type(), Binary::schema()),
        ];
        vec![Reply { content, ..Reply::ok("", Binary::schema()) }]
    }
}

pub async fn one(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
) -> Result<Json<ObjectOnBoard>, Problem> {
    let refused = || RequestError::new("id", &id, "o and 16 hex digits");
    let wanted = object_id(&id).ok_or_else(refused)?;
    app.within_limits(None, move |app, budget| {
        let on_board = app.engine.on_board().map_err(query_problem)?;
        let snapshot = &on_board.snapshot;
        let names = app.engine.names(&on_board, NAMES_WAIT, budget).map_err(query_problem)?;
        let found = app.engine.object(snapshot, names, wanted, budget).map_err(query_problem)?;
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
