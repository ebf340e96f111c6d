//! The query parameters of `/v1/query` and `/v1/objects`.

use std::str::FromStr;

use axum::extract::Query;
use axum::extract::rejection::QueryRejection;
use slag_service::problem::Problem;
use slag_service::routes::Parameter;

use super::body::Body;
use crate::http::problem::parameter_problem;
use crate::query::{
    AreaBall, AreaBox, Corner, DEFAULT_LIMIT, DEFAULT_MIN_COUNT, LatLon, Point, RequestError, parse_box,
    parse_point,
};

pub type Pairs = Query<Vec<(String, String)>>;

/// Returns the parameters of `/v1/query`.
pub fn query_parameters() -> [Parameter; 18] {
    [
        Parameter::new("text", "mug on the table", "what to look for; may be repeated"),
        Parameter::new("relations", "off", "take texts as they are, even if they name a relation"),
        Parameter::new(
            "negative",
            "wall, floor",
            "a negative prompt, commas included; may be repeated; or canonical",
        ),
        Parameter::new("kind", "objects", "objects, clusters or gaussians"),
        Parameter::new("limit", "10", format!("answers to a text in a page (default: {DEFAULT_LIMIT})")),
        Parameter::new("offset", "0", "answers to a text before the page"),
        Parameter::new(
            "min_score",
            "0.1",
            "least cosine, or relevancy with negatives (default: the scene's)",
        ),
        Parameter::new(
            "near",
            "x,y,z",
            "where the asker is: relations are seen from there, and nearer answers rank higher",
        ),
        Parameter::new(
            "near_lat_lon",
            "lat,lon",
            "the same on the earth, with the height if it is known: lat,lon,height",
        ),
        Parameter::new("heading_rad", "1.57", "where the asker looks, from x towards y"),
        Parameter::new("radius", "r", "only within this distance of the asker"),
        Parameter::new("box", "x,y,z,x,y,z", "only between two corners"),
        Parameter::new("polygon", "x,y,x,y,x,y", "only inside this outline, seen from above"),
        Parameter::new("polygon_lat_lon", "lat,lon,...", "the same on the earth"),
        Parameter::new(
            "min_count",
            "n",
            format!("least Gaussians of an answer (default: {DEFAULT_MIN_COUNT})"),
        ),
        Parameter::new("voxel", "v", "edge of the voxels that join Gaussians to clusters"),
        Parameter::new("precision", "measured", "centroids, measured or exact (default: exact)"),
        Parameter::new("time_budget_ms", "500", "give up after this time"),
    ]
}

/// Returns the parameters of `/v1/objects`.
pub fn objects_parameters() -> [Parameter; 5] {
    [
        Parameter::new("limit", "100", "objects in a page (default: 100, at most 1000)"),
        Parameter::new("after", "o0123456789abcdef", "the id that the page begins after"),
        Parameter::new("near", "x,y,z", "with radius: only objects within this distance"),
        Parameter::new("radius", "r", "with near"),
        Parameter::new("min_size", "0.5", "least length of the box's longest edge, world units"),
    ]
}

/// Returns the pairs of a query string.
pub fn pairs(pairs: Result<Pairs, QueryRejection>) -> Result<Vec<(String, String)>, Problem> {
    let refused = |e: QueryRejection| {
        parameter_problem(RequestError::new("query string", &e.body_text(), "name=value pairs"))
    };
    pairs.map(|Query(pairs)| pairs).map_err(refused)
}

/// Refuses parameters that are unknown or repeated.
pub fn check_names(
    pairs: &[(String, String)],
    known: &[Parameter],
    repeatable: &[&str],
) -> Result<(), RequestError> {
    for (at, (name, value)) in pairs.iter().enumerate() {
        if !known.iter().any(|parameter| parameter.name == name) {
            let names = known.iter().map(|parameter| parameter.name).collect::<Vec<_>>().join(", ");
            let name: String = name.chars().take(40).collect();
            let name = name.escape_debug().to_string();
            return Err(RequestError::new(&name, value, format!("one of {names}")));
        }
        if !repeatable.contains(&name.as_str()) && pairs[..at].iter().any(|(before, _)| before == name) {
            return Err(RequestError::new(name, value, "one value"));
        }
    }
    Ok(())
}

/// Reads the query string of `/v1/query` as the body that asks for the same.
///
/// # Errors
/// The first parameter that is unknown, repeated or does not parse.
pub fn parse(pairs: &[(String, String)]) -> Result<Body, RequestError> {
    check_names(pairs, &query_parameters(), &["text", "negative"])?;
    let mut body = Body::default();
    let mut radius = None;
    for (name, value) in pairs {
        let refused = |expected: String| RequestError::new(name, value, expected);
        match name.as_str() {
            "text" => body.texts.push(value.clone()),
            "relations" => {
                body.relations = Some(match value.as_str() {
                    "on" => true,
                    "off" => false,
                    _ => return Err(refused("on or off".into())),
                });
            }
            "negative" => body.negatives.push(value.clone()),
            "kind" => body.kind = Some(value.parse().map_err(refused)?),
            "limit" => body.limit = Some(number(name, value, "a whole number")?),
            "offset" => body.offset = number(name, value, "a whole number")?,
            "min_score" => body.min_score = Some(number(name, value, "a number")?),
            "near" => body.near = Some(Point::World(parse_point(value).map_err(refused)?.to_array())),
            "near_lat_lon" => body.near = Some(Point::Geographic(lat_lon(name, value)?)),
            "heading_rad" => body.heading_rad = Some(number(name, value, "a number")?),
            "radius" => radius = Some(number(name, value, "a number")?),
            "box" => {
                let bounds = parse_box(value).map_err(refused)?;
                let [from, to] = [bounds.min, bounds.max].map(|corner| Point::World(corner.to_array()));
                body.region.bounds = Some(AreaBox { from, to });
            }
            "polygon" => {
                let corners = numbers(name, value)?;
                body.region.polygon = corners.chunks(2).map(|c| Corner::World([c[0], c[1]])).collect();
            }
            "polygon_lat_lon" => {
                let corner = |c: &[f64]| Corner::Geographic(LatLon { lat: c[0], lon: c[1], height: None });
                body.region.polygon = numbers(name, value)?.chunks(2).map(corner).collect();
            }
            "min_count" => body.min_count = Some(number(name, value, "a whole number")?),
            "voxel" => body.voxel = Some(number(name, value, "a number")?),
            "precision" => body.precision = Some(value.clone()),
            "time_budget_ms" => body.time_budget_ms = Some(number(name, value, "a whole number")?),
            _ => {}
        }
    }
    body.region.ball = match (radius, body.near) {
        (None, _) => None,
        (Some(radius), Some(centre)) => Some(AreaBall { centre, radius }),
        (Some(radius), None) => {
            let expected = format!("where the asker is, because radius is {radius}");
            return Err(RequestError::new("near", "nothing", expected));
        }
    };
    Ok(body)
}

/// Reads a number.
pub fn number<T: FromStr>(name: &str, value: &str, expected: &str) -> Result<T, RequestError> {
    value.trim().parse().map_err(|_| RequestError::new(name, value, expected))
}

/// Reads an even number of numbers.
fn numbers(name: &str, value: &str) -> Result<Vec<f64>, RequestError> {
    let numbers: Option<Vec<f64>> = value.split(',').map(|number| number.trim().parse().ok()).collect();
    let numbers = numbers.filter(|numbers| numbers.len() % 2 == 0);
    numbers.ok_or_else(|| RequestError::new(name, value, "pairs of numbers, separated by commas"))
}

/// Reads a geographic position.
pub fn lat_lon(name: &str, value: &str) -> Result<LatLon, RequestError> {
    let numbers: Option<Vec<f64>> = value.split(',').map(|number| number.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some([lat, lon]) => Ok(LatLon { lat: *lat, lon: *lon, height: None }),
        Some([lat, lon, height]) => Ok(LatLon { lat: *lat, lon: *lon, height: Some(*height) }),
        _ => Err(RequestError::new(name, value, "lat,lon or lat,lon,height")),
    }
}
