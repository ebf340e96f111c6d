//! `/query`'s parameters, each error naming its parameter.

use std::str::FromStr;

use axum::http::{HeaderMap, header};

use crate::query::{AnswerKind, Format, QueryRequest, RequestError, parse_box, parse_point};

/// The parameters there are.
pub const NAMES: [&str; 12] = [
    "text",
    "negatives",
    "limit",
    "threshold",
    "near",
    "radius",
    "box",
    "kind",
    "voxel",
    "min_count",
    "precision",
    "format",
];

/// Reads a question and the format of its answer from decoded `name=value` pairs; values are checked by
/// [`QueryRequest::check`].
///
/// # Errors
/// The first parameter that is unknown, given twice (but for `text`) or does not parse, or `text` when it is
/// missing.
pub fn parse(
    pairs: &[(String, String)],
    headers: &HeaderMap,
) -> Result<(QueryRequest, Format), RequestError> {
    let mut request = QueryRequest { texts: Vec::new(), ..QueryRequest::new("") };
    let mut format = accepted(headers);
    for (at, (name, value)) in pairs.iter().enumerate() {
        if name != "text" && pairs[..at].iter().any(|(before, _)| before == name) {
            return Err(RequestError::new(name, value, "one value"));
        }
        let refused = |expected: String| RequestError::new(name, value, expected);
        match name.as_str() {
            "text" => request.texts.push(value.clone()),
            "negatives" => request.negatives = value.parse().map_err(refused)?,
            "limit" => request.limit = Some(number(name, value, "a whole number")?),
            "threshold" => request.threshold = Some(number(name, value, "a number")?),
            "near" => request.near = Some(parse_point(value).map_err(refused)?),
            "radius" => request.radius = Some(number(name, value, "a number")?),
            "box" => request.bounds = Some(parse_box(value).map_err(refused)?),
            "kind" => request.kind = Some(value.parse().map_err(refused)?),
            "voxel" => request.voxel = Some(number(name, value, "a number")?),
            "min_count" => request.min_count = number(name, value, "a whole number")?,
            "precision" => request.precision = value.parse().map_err(refused)?,
            "format" => format = value.parse().map_err(refused)?,
            _ => {
                let name: String = name.chars().take(40).collect();
                let expected = format!("one of {}", NAMES.join(", "));
                return Err(RequestError::new(&name.escape_debug().to_string(), value, expected));
            }
        }
    }
    if request.texts.is_empty() {
        return Err(RequestError::new("text", "nothing", "words to look for"));
    }
    if format == Format::Arrow && request.kind != Some(AnswerKind::Gaussians) {
        return Err(RequestError::new(
            "kind",
            &request.kind.unwrap_or_default().to_string(),
            "gaussians, since format is arrow",
        ));
    }
    Ok((request, format))
}

/// Returns the format that `Accept` names: columns if it lists them, JSON otherwise.
fn accepted(headers: &HeaderMap) -> Format {
    let arrow = Format::Arrow.media_type();
    let mut values = headers.get_all(header::ACCEPT).iter().filter_map(|value| value.to_str().ok());
    let names_arrow = |value: &str| {
        value
            .split(',')
            .any(|range| range.split(';').next().is_some_and(|r| r.trim().eq_ignore_ascii_case(arrow)))
    };
    if cfg!(feature = "arrow") && values.any(names_arrow) { Format::Arrow } else { Format::Json }
}

fn number<T: FromStr>(name: &str, value: &str, expected: &str) -> Result<T, RequestError> {
    value.trim().parse().map_err(|_| RequestError::new(name, value, expected))
}
