//! The part of space that a request names.

use std::sync::Arc;

use glam::{DVec2, DVec3};
use schemars::JsonSchema;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};
use slag_common::frames::{Aabb, Geographic};
use slag_common::manifest::Manifest;

use super::request::{RequestError, check_region};
use crate::score::{Ball, MAX_COORDINATE, MAX_CORNERS, Polygon, Region};

/// A ball, a box and a polygon, each optional; what lies in all of them is asked for.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields, remote = "Self")]
pub struct Area {
    /// A ball.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ball: Option<AreaBall>,
    /// A box along the axes of the world frame.
    #[serde(rename = "box", skip_serializing_if = "Option::is_none")]
    pub bounds: Option<AreaBox>,
    /// A polygon of 3 to 256 corners, seen from above.
    #[schemars(length(min = 3, max = MAX_CORNERS))]
    #[serde(skip_serializing_if = "Vec::is_empty", deserialize_with = "corners")]
    pub polygon: Vec<Corner>,
}

/// A ball.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub struct AreaBall {
    /// Its centre.
    pub centre: Point,
    /// Its radius, world units.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = MAX_COORDINATE))]
    pub radius: f64,
}

/// A box, by two opposite corners.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub struct AreaBox {
    /// One corner.
    pub from: Point,
    /// The corner opposite.
    pub to: Point,
}

slag_common::named_members!(Area, AreaBall, AreaBox; Serialize);

/// Reads the corners of a polygon; none is an error, as it would mean the whole scene.
fn corners<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<Corner>, D::Error> {
    let corners = Vec::deserialize(from)?;
    if corners.is_empty() {
        Err(D::Error::custom("expected a polygon of 3 corners or more"))
    } else {
        Ok(corners)
    }
}

impl Area {
    /// Returns the region in the world frame. Errors name the invalid member.
    pub(crate) fn in_world(&self, manifest: &Manifest) -> Result<Region, RequestError> {
        let ball = self.ball.map(|AreaBall { centre, radius }| {
            Ok::<_, RequestError>(Ball { centre_in_world: centre.in_world("centre", manifest)?, radius })
        });
        let bounds = self.bounds.map(|AreaBox { from, to }| {
            let (from, to) = (from.in_world("box", manifest)?, to.in_world("box", manifest)?);
            Ok::<_, RequestError>(Aabb { min: from.min(to), max: from.max(to) })
        });
        let mut region = Region { ball: ball.transpose()?, bounds: bounds.transpose()?, polygon: None };
        if !self.polygon.is_empty() {
            let corners = self.polygon.iter().map(|corner| corner.in_world("polygon", manifest));
            let corners = corners.collect::<Result<Vec<_>, _>>()?;
            let found = format!("{} corners", corners.len());
            let refused = || {
                let expected =
                    format!("a polygon of 3 to {MAX_CORNERS} corners within bounds, not all on a line");
                RequestError::new("polygon", &found, expected)
            };
            region.polygon = Some(Arc::new(Polygon::new(corners).ok_or_else(refused)?));
        }
        check_region(&region)?;
        Ok(region)
    }
}

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
    pub fn in_world(self, parameter: &str, manifest: &Manifest) -> Result<DVec2, RequestError> {
        match self {
            Self::World(corner) => Ok(DVec2::from(corner)),
            Self::Geographic(position) => Ok(position.in_world(parameter, manifest)?.truncate()),
        }
    }
}
