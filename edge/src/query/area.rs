//! The part of space that a request names.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};
use slag_common::frames::Aabb;
use slag_common::manifest::Manifest;

use super::point::{Corner, Point};
use super::request::RequestError;
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

/// Reads the corners of a polygon; none would be the whole scene.
fn corners<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<Corner>, D::Error> {
    let corners = Vec::deserialize(from)?;
    if corners.is_empty() {
        Err(D::Error::custom("expected a polygon of 3 corners or more"))
    } else {
        Ok(corners)
    }
}

impl Area {
    /// Returns the area in the world frame.
    pub(crate) fn in_world(&self, manifest: &Manifest) -> Result<Region, RequestError> {
        let point = |point: Point| point.in_world("region", manifest);
        let ball = self.ball.map(|AreaBall { centre, radius }| {
            Ok::<_, RequestError>(Ball { centre_in_world: point(centre)?, radius })
        });
        let bounds = self.bounds.map(|AreaBox { from, to }| {
            let (from, to) = (point(from)?, point(to)?);
            Ok::<_, RequestError>(Aabb { min: from.min(to), max: from.max(to) })
        });
        let mut region = Region { ball: ball.transpose()?, bounds: bounds.transpose()?, polygon: None };
        if !self.polygon.is_empty() {
            let corners = self.polygon.iter().map(|corner| corner.in_world("region", manifest));
            let corners = corners.collect::<Result<Vec<_>, _>>()?;
            let found = format!("{} corners", corners.len());
            let refused = || {
                let expected =
                    format!("a polygon of 3 to {MAX_CORNERS} corners within bounds, not all on a line");
                RequestError::new("region", &found, expected)
            };
            region.polygon = Some(Arc::new(Polygon::new(corners).ok_or_else(refused)?));
        }
        Ok(region)
    }
}
