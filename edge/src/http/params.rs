//! The parameters of `/query`.

use std::fmt::Display;
use std::str::FromStr;

use axum::http::{HeaderMap, header};
use slag_service::routes::Parameter;

use crate::query::{
    AnswerKind, DEFAULT_LIMIT, DEFAULT_MIN_COUNT, Format, QueryRequest, RequestError, parse_box, parse_point,
};
use crate::score::Precision;

/// Returns the parameters, with the values and defaults of the types behind them.
pub fn parameters() -> [Parameter; 12] {
    let (kind, precision, format) =
        (list(&AnswerKind::ALL), list(&Precision::ALL), list(Format::available()));
    let default_precision = Precision::default();
    [
        Parameter::new("text", "chair", "what to look for; several are answered in one pass, as a batch"),
        Parameter::new(
            "negatives",
            "canonical",
            "or none, or a,b,c: scores are relevancy against these (default: none)",
        ),
        Parameter::new("limit", "10", format!("most answers to a text (default: {DEFAULT_LIMIT})")),
        Parameter::new(
            "threshold",
            "0.1",
            "least cosine, or relevancy with negatives (default: the scene's)",
        ),
        Parameter::new(
            "near",
            "x,y,z",
            "where the asker is: answers have distances and nearer ones rank higher",
        ),
        Parameter::new("radius", "r", "only within this distance of near"),
        Parameter::new("box", "x,y,z,x,y,z", "only between two corners"),
        Parameter::new(
            "kind",
            "clusters",
            format!("{kind} (default: objects where the scene has them, else clusters)"),
        ),
        Parameter::new("voxel", "v", "edge of the voxels that join Gaussians to clusters"),
        Parameter::new(
            "min_count",
            "n",
            format!("smaller clusters are dropped (default: {DEFAULT_MIN_COUNT})"),
        ),
        Parameter::new(
            "precision",
            "measured",
            format!("{precision}, fastest first (default: {default_precision})"),
        ),
        Parameter::new(
            "format",
            "json",
            format!("{format}; arrow: Gaussians as columns; ply: the answers' Gaussians as points"),
        ),
    ]
}

fn list(values: &[impl Display]) -> String {
    values.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

/// Reads a question and the format of its answer from decoded `name=value` pairs; [`QueryRequest::check`]
/// checks the values.
///
/// # Errors
/// The first parameter that is unknown, repeated (except `text`) or does not parse, or `text` if it is missing.
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
                let expected = format!("one of {}", parameters().map(|parameter| parameter.name).join(", "));
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
    request.members = format == Format::Ply;
    Ok((request, format))
}

/// Returns the format of `Accept`: columns if it lists them, JSON otherwise.
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
