//! Points as clients write them: in the world frame, or as latitude and longitude.

use glam::{DVec2, DVec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_common::frames::Geographic;
use slag_common::manifest::Manifest;

use super::request::RequestError;
use crate::score::MAX_COORDINATE;

/// A point of a request.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(
    untagged,
    expecting = "expected [x, y, z] in the world frame, or lat, lon and perhaps height by their names"
)]
pub enum Point {
    /// In the world frame: x, y, z.
    World(#[schemars(inner(range(min = -MAX_COORDINATE, max = MAX_COORDINATE)))] [f64; 3]),
    /// WGS 84; needs a geo-referenced scene.
    Geographic(LatLon),
}

/// A corner of a polygon.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged, expecting = "expected [x, y] in the world frame, or lat and lon by their names")]
pub enum Corner {
    /// In the world frame: x, y.
    World(#[schemars(inner(range(min = -MAX_COORDINATE, max = MAX_COORDINATE)))] [f64; 2]),
    /// WGS 84; needs a geo-referenced scene.
    Geographic(LatLon),
}

/// A geographic position.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub struct LatLon {
    /// Latitude, degrees, north positive.
    #[schemars(range(min = -90, max = 90))]
    pub lat: f64,
    /// Longitude, degrees, east positive.
    #[schemars(range(min = -180, max = 180))]
    pub lon: f64,
    /// Height in metres; that of the scene's origin if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height: Option<f64>,
}

slag_common::named_members!(LatLon; Serialize);

impl LatLon {
    fn in_world(self, parameter: &str, manifest: &Manifest) -> Result<DVec3, RequestError> {
        let Self { lat, lon, height } = self;
        let Some(geo) = manifest.geo_reference else {
            let expected = "x, y, z in the world frame, since the scene has no geographic reference";
            return Err(RequestError::new(parameter, "lat, lon", expected));
        };
        if !(lat.abs() <= 90.0 && lon.abs() <= 180.0) {
            let found = format!("{lat}, {lon}");
            return Err(RequestError::new(parameter, &found, "lat within ±90 and lon within ±180"));
        }
        let height_m = height.unwrap_or(geo.origin.height_m);
        Ok(geo.world_from_geographic(Geographic { latitude_deg: lat, longitude_deg: lon, height_m }))
    }
}

impl Point {
    /// Returns the point in the world frame. `parameter`: its name, for the error.
    pub fn in_world(self, parameter: &str, manifest: &Manifest) -> Result<DVec3, RequestError> {
        let point = match self {
            Self::World(point) => DVec3::from(point),
            Self::Geographic(position) => position.in_world(parameter, manifest)?,
        };
        if point.is_finite() && point.abs().max_element() <= MAX_COORDINATE {
            return Ok(point);
        }
        let expected = format!("three numbers within ±{MAX_COORDINATE:e}");
        Err(RequestError::new(parameter, &point.to_string(), expected))
    }
}

impl Corner {
    /// Returns the corner in the world frame.
    pub fn in_world(self, parameter: &str, manifest: &Manifest) -> Result<DVec2, RequestError> {
        match self {
            Self::World(corner) => Ok(DVec2::from(corner)),
            Self::Geographic(position) => Ok(position.in_world(parameter, manifest)?.truncate()),
        }
    }
}
