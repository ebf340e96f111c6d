//! `GET /v1/objects` and below: the things on board.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use schemars::{JsonSchema, SchemaGenerator};
use serde::Deserialize;
use slag_api::objects::{ObjectOnBoard, ObjectPage};
use slag_common::manifest::Manifest;
use slag_common::objects::parse_public_id;
use slag_service::params::{Params, PathText};
use slag_service::problem::Problem;
use slag_service::replies::{As, Binary, Described, Reply};

use crate::http::app::App;
use crate::http::forms::{AreaParams, BallParams, ObjectIdText};
use crate::query::{Area, ListFormat, NAMES_WAIT, ObjectFilter, ObjectOrder, RequestError, Scene};
use crate::store::Snapshot;

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
        let on_board = app.engine.on_board()?;
        let filter = params.filter(area, &on_board.snapshot.manifest)?;
        let page = app.engine.objects(&on_board, &filter, limit, NAMES_WAIT, budget)?;
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

fn wanted(id: &str) -> Result<u64, RequestError> {
    parse_public_id(id).ok_or_else(|| RequestError::new("id", id, "o and 16 hex digits"))
}

fn not_on_board(id: &str, snapshot: &Snapshot) -> Problem {
    let generation = snapshot.manifest.generation;
    let detail =
        format!("generation {generation} has no object {id} on board; GET /v1/objects lists those it has");
    Problem::new(StatusCode::NOT_FOUND, "no-such-object", "No such object", detail)
}

pub async fn one(
    State(app): State<Arc<App>>,
    PathText(id): PathText,
) -> Result<Json<ObjectOnBoard>, Problem> {
    let wanted = wanted(&id)?;
    app.within_limits(None, move |app, budget| {
        let on_board = app.engine.on_board()?;
        let snapshot = &on_board.snapshot;
        let names = app.engine.names(&on_board, NAMES_WAIT, budget)?;
        let found = Scene::of(snapshot).object(wanted, names, budget);
        budget.check()?;
        found.map(Json).ok_or_else(|| not_on_board(&id, snapshot))
    })
    .await
}

/// Sends the small picture of an object.
pub async fn thumbnail(
    State(app): State<Arc<App>>,
    PathText(id): PathText,
) -> Result<As<JpegPicture>, Problem> {
    let wanted = wanted(&id)?;
    let picture = app.within_limits(None, move |app, budget| {
        let snapshot = app.engine.snapshot()?;
        let picture = Scene::of(&snapshot).thumbnail(wanted);
        budget.take(picture.iter().flatten().map(Vec::len).sum());
        budget.check()?;
        picture.ok_or_else(|| not_on_board(&id, &snapshot))?.ok_or_else(|| {
            let detail = format!(
                "{id} has no small picture on board; balanced and exact shards carry them, and compact ones of a store encoded with --appearance"
            );
            Problem::new(StatusCode::NOT_FOUND, "no-thumbnail", "No thumbnail", detail)
        })
    });
    Ok(As::new(([(header::CONTENT_TYPE, JpegPicture::MEDIA_TYPE)], picture.await?)))
}

pub struct JpegPicture;

impl JpegPicture {
    const MEDIA_TYPE: &str = "image/jpeg";
}

impl Described for JpegPicture {
    fn replies(_: &mut SchemaGenerator) -> Vec<Reply> {
        vec![Reply::ok(Self::MEDIA_TYPE, Binary::schema())]
    }
}
