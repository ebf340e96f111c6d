//! The parameters of `/query`.

use std::str::FromStr;

use axum::http::{HeaderMap, header};
use slag_service::routes::Parameter;

use super::forms;
use crate::query::{
    AnswerKind, DEFAULT_LIMIT, Format, MAX_GAUSSIANS, MAX_TEXTS, QueryRequest, RequestError, parse_box,
    parse_point,
};

/// Returns the parameters, with the values and defaults of the types behind them.
pub fn parameters() -> [Parameter; 12] {
    let formats = Format::available().iter().map(|format| format.name());
    let kinds = AnswerKind::ALL.map(AnswerKind::name).join(", ");
    [
        forms::text("chair", "what to look for; several are answered in one pass, as a batch")
            .required()
            .repeated(MAX_TEXTS),
        Parameter::new::<String>(
            "negatives",
            "canonical",
            "or none, or a,b,c: scores are relevancy against these",
        )
        .details(
            "canonical: object, things, stuff, texture. At most 16 phrases. Relevancy is LERF's, 1 / (1 + exp(-10 (q.E - max n.E))).",
        )
        .or("none"),
        Parameter::new::<usize>("limit", "10", "most answers to a text")
            .details("Over all texts at most 10,000 clusters or 1,000,000 Gaussians.")
            .within(1, MAX_GAUSSIANS)
            .or(DEFAULT_LIMIT),
        forms::least_score("threshold"),
        forms::near("where the asker is: answers have distances and nearer ones rank higher"),
        forms::length("radius", "r", "only within this distance of near, world units"),
        forms::bounds(),
        Parameter::new::<AnswerKind>(
            "kind",
            "clusters",
            format!("{kinds} (default: objects where the scene has them, else clusters)"),
        ),
        forms::voxel(),
        forms::min_count(),
        forms::precision(),
        Parameter::new::<String>(
            "format",
            "json",
            "arrow: Gaussians as columns; ply: the answers' Gaussians as points",
        )
        .details(
            "arrow is for kind=gaussians only. Accept: application/vnd.apache.arrow.stream has the same effect.",
        )
        .limit("enum", formats.collect::<Vec<_>>())
        .or(Format::default().name()),
    ]
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
