//! `GET /v1/cells` and `GET /v1/coverage.geojson`.

use std::collections::BTreeMap;

use axum::Json;
use axum::extract::State;
use axum::http::header;
use glam::DVec3;
use schemars::{JsonSchema, SchemaGenerator};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use slag_common::Hash32;
use slag_common::frames::Aabb;
use slag_common::manifest::{Manifest, ShardRecord};
use slag_common::shard::Profile;
use slag_service::params::{Params, RequestError};
use slag_service::problem::Problem;
use slag_service::replies::{As, Described, Reply};

use super::problem::{bad_parameter, not_geo_referenced};
use super::state::{AppState, Snapshot};
use crate::publish::geographic;

/// A centre, in one of two frames, and a radius.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema)]
pub(super) struct CellsQuery {
    /// Centre in the world frame, with y and z.
    #[schemars(example = 1)]
    x: Option<f64>,
    /// See x.
    #[schemars(example = 2)]
    y: Option<f64>,
    /// See x.
    #[schemars(example = 3)]
    z: Option<f64>,
    /// Or centre on the earth, degrees WGS 84, with lon.
    #[schemars(range(min = -90, max = 90), example = 46.8)]
    lat: Option<f64>,
    /// See lat.
    #[schemars(range(min = -180, max = 180), example = -92)]
    lon: Option<f64>,
    /// Metres above the ellipsoid; by default the scene's origin.
    #[schemars(example = 158.5)]
    height: Option<f64>,
    /// Distance from the centre, units of the world frame.
    #[schemars(range(min = 0), example = 50)]
    radius: f64,
}

impl CellsQuery {
    /// Centre and radius in the world frame.
    fn ball_in_world(self, manifest: &Manifest) -> Result<(DVec3, f64), Problem> {
        if !(self.radius >= 0.0 && self.radius.is_finite()) {
            let expected = "a finite number, not negative, in units of the world frame";
            return Err(RequestError::new("radius", &self.radius.to_string(), expected).into());
        }
        let centre = match self {
            Self { x: Some(x), y: Some(y), z: Some(z), lat: None, lon: None, height: None, .. } => {
                DVec3::new(x, y, z)
            }
            Self { x: None, y: None, z: None, lat: Some(lat), lon: Some(lon), height, .. } => {
                geographic::world_from_geographic(manifest, lat, lon, height).map_err(bad_parameter)?
            }
            _ => return Err(bad_parameter("give the centre as x, y and z, or as lat and lon (and height)")),
        };
        if !centre.is_finite() {
            return Err(bad_parameter("the centre must be finite"));
        }
        Ok((centre, self.radius))
    }
}

/// Cells, by their distance.
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "Cells")]
pub(super) struct CellsAnswer {
    /// Generation served.
    generation: u64,
    /// The encoder of its embeddings.
    encoder_id: Hash32,
    /// The cells.
    cells: Vec<CellAnswer>,
}

/// A cell near the centre.
#[derive(Serialize, JsonSchema)]
struct CellAnswer {
    /// The cell.
    cell_id: u32,
    /// Box around the extents of its Gaussians, world frame.
    bounds: Aabb,
    /// Gaussians.
    n_gaussians: u32,
    /// From the centre to the box, world units; 0 inside.
    #[schemars(range(min = 0))]
    distance: f64,
    /// Its shards, one per profile.
    #[schemars(extend("propertyNames" = serde_json::json!({ "enum": Profile::ALL.map(Profile::name) })))]
    shards: BTreeMap<Profile, ShardRecord>,
}

pub(super) async fn cells(
    State(service): AppState,
    Params(query): Params<CellsQuery>,
) -> Result<Json<CellsAnswer>, Problem> {
    let search = move |snapshot: &Snapshot| {
        let manifest = snapshot.world();
        let (centre, radius) = query.ball_in_world(manifest)?;
        let near = snapshot.index.within(centre, radius).into_iter().map(|i| &manifest.cells[i]);
        let cells = near.map(|cell| CellAnswer {
            cell_id: cell.cell_id,
            bounds: cell.bounds,
            n_gaussians: cell.n_gaussians,
            distance: cell.bounds.distance_to(centre),
            shards: cell.shards.clone(),
        });
        let cells = cells.collect();
        Ok(CellsAnswer { generation: manifest.generation, encoder_id: manifest.encoder.id, cells })
    };
    service.with_current(search).await.map(Json)
}

/// A GeoJSON feature for each cell.
#[derive(JsonSchema)]
#[expect(dead_code, reason = "the schema of a document that the geojson crate writes")]
pub(super) struct FeatureCollection {
    /// FeatureCollection.
    #[schemars(rename = "type", extend("const" = "FeatureCollection"))]
    kind: String,
    /// The features.
    features: Vec<Map<String, Value>>,
}

const GEO_JSON: &str = "application/geo+json";

impl Described for FeatureCollection {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        vec![Reply::ok(GEO_JSON, schemas.subschema_for::<Self>())]
    }
}

pub(super) async fn coverage(State(service): AppState) -> Result<As<FeatureCollection>, Problem> {
    let draw = |snapshot: &Snapshot| {
        let drawn = geographic::coverage(snapshot.world()).map_err(not_geo_referenced)?;
        Ok(drawn.to_string())
    };
    let text = service.with_current(draw).await?;
    Ok(As::new(([(header::CONTENT_TYPE, GEO_JSON)], text)))
}
