//! The query parameters of `/v1/query`, and reading those of all routes.

use std::str::FromStr;

use axum::extract::Query;
use axum::extract::rejection::QueryRejection;
use serde_json::json;
use slag_service::problem::Problem;
use slag_service::routes::Parameter;

use super::body::Body;
use crate::http::forms::{self, Words};
use crate::http::problem::parameter_problem;
use crate::query::{
    AnswerKind, AreaBall, AreaBox, Corner, DEFAULT_LIMIT, LatLon, MAX_NEGATIVES, MAX_PAGE, MAX_TEXTS, Point,
    RequestError, parse_box, parse_point,
};

pub type Pairs = Query<Vec<(String, String)>>;

/// Returns the parameters of `/v1/query`.
pub fn query_parameters() -> [Parameter; 18] {
    [
        forms::text("mug on the table", "what to look for; may be repeated")
            .details("A text that names a relation (mug on the table) is understood as a phrase.")
            .required()
            .repeated(MAX_TEXTS),
        Parameter::new::<String>(
            "relations",
            "off",
            "off: take texts as they are, even if they name a relation",
        )
        .limit("enum", json!(["on", "off"]))
        .or("on"),
        negative(),
        Parameter::new::<AnswerKind>(
            "kind",
            "objects",
            "objects, clusters or gaussians (default: objects where the scene has them, else clusters)",
        ),
        Parameter::new::<usize>("limit", "10", "answers to a text in a page; 10,000 over all texts at most")
            .within(1, MAX_PAGE)
            .or(DEFAULT_LIMIT),
        Parameter::new::<usize>("offset", "0", "answers to a text before the page").or(0),
        forms::least_score("min_score"),
        forms::near("where the asker is: relations are seen from there, and nearer answers rank higher"),
        forms::near_lat_lon(),
        Parameter::new::<f64>("heading_rad", "1.57", "where the asker looks, from the world's x towards y"),
        forms::length("radius", "r", "only within this distance of the asker, world units"),
        forms::bounds(),
        forms::polygon(),
        forms::polygon_lat_lon(),
        forms::min_count(),
        forms::voxel(),
        forms::precision(),
        Parameter::new::<u64>("time_budget_ms", "500", "give up after this time").limit("minimum", 1),
    ]
}

/// Returns the parameter `negative`.
pub fn negative() -> Parameter {
    let summary = "a negative prompt, commas included; may be repeated; or canonical";
    Parameter::new::<Words>("negative", "wall, floor", summary)
        .details("canonical alone stands for object, things, stuff, texture.")
        .repeated(MAX_NEGATIVES)
}

pub fn pairs(pairs: Result<Pairs, QueryRejection>) -> Result<Vec<(String, String)>, Problem> {
    let refused = |e: QueryRejection| {
        parameter_problem(RequestError::new("query string", &e.body_text(), "name=value pairs"))
    };
    pairs.map(|Query(pairs)| pairs).map_err(refused)
}

/// Refuses parameters that are unknown, or repeated where only one can be.
pub fn check_names(pairs: &[(String, String)], known: &[Parameter]) -> Result<(), RequestError> {
    for (at, (name, value)) in pairs.iter().enumerate() {
        let Some(parameter) = known.iter().find(|parameter| parameter.name == name) else {
            let names = known.iter().map(|parameter| parameter.name).collect::<Vec<_>>().join(", ");
            let name: String = name.chars().take(40).collect();
            let name = name.escape_debug().to_string();
            return Err(RequestError::new(&name, value, format!("one of {names}")));
        };
        if parameter.most.is_none() && pairs[..at].iter().any(|(before, _)| before == name) {
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
    check_names(pairs, &query_parameters())?;
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
