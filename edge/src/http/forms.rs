//! Parameter values with a syntax of their own, and parameters shared by routes.

use glam::DVec3;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::Deserialize;
use serde::de::{Deserializer, Error};
use slag_common::frames::Aabb;
use slag_common::objects::parse_public_id;

use crate::query::{
    Area, AreaBall, AreaBox, Corner, LatLon, Negatives, OBJECT_ID, Point, RequestError, check_length,
    numbers, parse_box, parse_point,
};
use crate::score::{MAX_COORDINATE, MAX_CORNERS};

/// A number between commas.
const NUMBER: &str = r"-?[0-9]{1,9}(\.[0-9]{1,9})?";
const LAT_LON: &str = r"-?[0-8]?[0-9](\.[0-9]{1,9})?,-?(1[0-7][0-9]|[0-9]{1,2})(\.[0-9]{1,9})?";

/// Defines types of texts with a syntax: the value, its regular expression, and the parser.
macro_rules! texts {
    ($($name:ident($value:ty), $form:expr, $parse:expr;)+) => { $(
        pub struct $name(pub $value);

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
                $parse(&String::deserialize(from)?).map(Self).map_err(D::Error::custom)
            }
        }

        impl JsonSchema for $name {
            fn inline_schema() -> bool {
                true
            }

            fn schema_name() -> std::borrow::Cow<'static, str> {
                stringify!($name).into()
            }

            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                json_schema!({ "type": "string", "pattern": $form })
            }
        }
    )+ };
}

texts! {
    XyText([f64; 2]), several(NUMBER, 2, 2), xy;
    XyzText(DVec3), several(NUMBER, 3, 3), parse_point;
    LatLonText(LatLon), format!("^{LAT_LON}(,{NUMBER})?$"), lat_lon;
    BoxText(Aabb), several(NUMBER, 6, 6), parse_box;
    PolygonText(Vec<Corner>), several(&format!("{NUMBER},{NUMBER}"), 3, MAX_CORNERS), polygon;
    LatLonPolygonText(Vec<Corner>), several(LAT_LON, 3, MAX_CORNERS), lat_lon_polygon;
    ObjectIdText(u64), OBJECT_ID, id;
    NegativesText(Negatives), r"^[^\u0000-\u001f\u007f-\u009f]+$", str::parse;
}

/// Returns the regular expression of `least` to `most` comma-separated values.
fn several(value: &str, least: usize, most: usize) -> String {
    format!("^{value}(,{value}){{{},{}}}$", least - 1, most - 1)
}

fn xy(text: &str) -> Result<[f64; 2], &'static str> {
    let numbers = numbers(text).filter(|numbers| numbers.iter().all(|v| v.is_finite()));
    numbers.and_then(|numbers| numbers.try_into().ok()).ok_or("x,y")
}

fn lat_lon(text: &str) -> Result<LatLon, &'static str> {
    match numbers(text).as_deref() {
        Some([lat, lon]) => Ok(LatLon { lat: *lat, lon: *lon, height: None }),
        Some([lat, lon, height]) => Ok(LatLon { lat: *lat, lon: *lon, height: Some(*height) }),
        _ => Err("lat,lon or lat,lon,height"),
    }
}

fn polygon(text: &str) -> Result<Vec<Corner>, &'static str> {
    Ok(pairs(text)?.into_iter().map(Corner::World).collect())
}

fn lat_lon_polygon(text: &str) -> Result<Vec<Corner>, &'static str> {
    let corner = |[lat, lon]: [f64; 2]| Corner::Geographic(LatLon { lat, lon, height: None });
    Ok(pairs(text)?.into_iter().map(corner).collect())
}

fn pairs(text: &str) -> Result<Vec<[f64; 2]>, &'static str> {
    let numbers = numbers(text).filter(|numbers| numbers.len() % 2 == 0);
    let numbers = numbers.ok_or("pairs of numbers, separated by commas")?;
    Ok(numbers.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect())
}

fn id(text: &str) -> Result<u64, &'static str> {
    parse_public_id(text).ok_or("o and 16 hex digits")
}

pub fn point(near: Option<XyzText>, near_lat_lon: Option<LatLonText>) -> Result<Option<Point>, RequestError> {
    let world = near.map(|XyzText(point)| Point::World(point.to_array()));
    match (world, near_lat_lon.map(|LatLonText(point)| Point::Geographic(point))) {
        (Some(_), Some(_)) => Err(RequestError::new("near_lat_lon", "near as well", "one of the two")),
        (world, geographic) => Ok(world.or(geographic)),
    }
}

/// A box and an outline that answers must lie in.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct AreaParams {
    /// Only between two opposite corners.
    #[serde(rename = "box")]
    #[schemars(example = &"0,0,0,4,3,2")]
    bounds: Option<BoxText>,
    /// Only inside this outline of 3 to 256 corners, seen from above.
    #[schemars(example = &"0,0,4,0,4,3")]
    polygon: Option<PolygonText>,
    /// The same on the earth.
    #[schemars(example = &"46.8,-92.1,46.8,-92,46.9,-92")]
    polygon_lat_lon: Option<LatLonPolygonText>,
}

impl AreaParams {
    /// Returns the area, with the ball if there is one.
    pub fn area(self, ball: Option<(Point, f64)>) -> Result<Area, RequestError> {
        let corner = |corner: DVec3| Point::World(corner.to_array());
        let polygon = match (self.polygon, self.polygon_lat_lon) {
            (Some(_), Some(_)) => {
                return Err(RequestError::new("polygon_lat_lon", "polygon as well", "one of the two"));
            }
            (world, geographic) => world.map(|of| of.0).or(geographic.map(|of| of.0)).unwrap_or_default(),
        };
        Ok(Area {
            ball: ball.map(|(centre, radius)| AreaBall { centre, radius }),
            bounds: self.bounds.map(|BoxText(of)| AreaBox { from: corner(of.min), to: corner(of.max) }),
            polygon,
        })
    }
}

/// A ball, where near and radius are given.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
pub struct BallParams {
    /// With radius: only what lies within this distance; of a move, one end counts.
    #[schemars(example = &"2,1.5,0")]
    near: Option<XyzText>,
    /// The same on the earth, WGS 84: lat,lon or lat,lon,height.
    #[schemars(example = &"46.8,-92.1")]
    near_lat_lon: Option<LatLonText>,
    /// With near, world units.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = MAX_COORDINATE), example = 5)]
    radius: Option<f64>,
}

impl BallParams {
    /// # Errors
    /// One is there without the other, or the radius is none.
    pub fn ball(self) -> Result<Option<(Point, f64)>, RequestError> {
        match (point(self.near, self.near_lat_lon)?, self.radius) {
            (None, None) => Ok(None),
            (Some(near), Some(radius)) => check_length("radius", radius).map(|()| Some((near, radius))),
            (None, Some(_)) => Err(RequestError::new("near", "nothing", "x,y,z, because there is a radius")),
            (Some(_), None) => Err(RequestError::new("radius", "nothing", "a number, because there is near")),
        }
    }
}
