//! `/query`'s parameters, each error naming its parameter.

use std::str::FromStr;

use crate::query::{QueryRequest, RequestError, parse_point};

/// The parameters there are.
const NAMES: &str = "text, limit, threshold, near, radius, level, voxel, min_count";

/// Reads a question from decoded `name=value` pairs; values are checked by [`QueryRequest::check`].
///
/// # Errors
/// The first parameter that is unknown, given twice or does not parse, or `text` when it is missing.
pub fn parse(pairs: &[(String, String)]) -> Result<QueryRequest, RequestError> {
    let mut request = QueryRequest::new("");
    for (at, (name, value)) in pairs.iter().enumerate() {
        if pairs[..at].iter().any(|(before, _)| before == name) {
            return Err(RequestError::new(name, value, "one value"));
        }
        match name.as_str() {
            "text" => request.text.clone_from(value),
            "limit" => request.limit = Some(number(name, value, "a whole number")?),
            "threshold" => request.threshold = Some(number(name, value, "a cosine, -1 to 1")?),
            "near" => {
                request.near =
                    Some(parse_point(value).map_err(|expected| RequestError::new(name, value, expected))?);
            }
            "radius" => request.radius = Some(number(name, value, "a number")?),
            "level" => {
                request.level =
                    value.parse().map_err(|expected: String| RequestError::new(name, value, expected))?
            }
            "voxel" => request.voxel = Some(number(name, value, "a number")?),
            "min_count" => request.min_count = number(name, value, "a whole number")?,
            _ => {
                let name: String = name.chars().take(40).collect();
                return Err(RequestError::new(
                    &name.escape_debug().to_string(),
                    value,
                    format!("one of {NAMES}"),
                ));
            }
        }
    }
    if pairs.iter().all(|(name, _)| name != "text") {
        return Err(RequestError::new("text", "nothing", "words to look for"));
    }
    Ok(request)
}

fn number<T: FromStr>(name: &str, value: &str, expected: &str) -> Result<T, RequestError> {
    value.trim().parse().map_err(|_| RequestError::new(name, value, expected))
}
