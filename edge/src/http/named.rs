//! Names of refused parts of a request: the engine's name of each, translated for the query string or JSON.

use axum::extract::Request;
use axum::middleware::Next;
use axum::response::Response;
use slag_service::problem::Problem;

use crate::query::Ask;

/// Names refused parameters as the query string does.
pub async fn as_in_query(request: Request, next: Next) -> Response {
    let query = request.uri().query().map(str::to_owned);
    let mut response = next.run(request).await;
    if let Some(query) = query
        && let Some(problem) = response.extensions_mut().get_mut::<Problem>()
        && let Some(name) = problem.parameter().and_then(|parameter| in_query(parameter, &query))
    {
        problem.rename_parameter(name);
    }
    response
}

/// Returns another name of a parameter if the query string does not contain it.
fn in_query(parameter: &str, query: &str) -> Option<&'static str> {
    let has = |wanted: &str| query.split('&').any(|pair| pair.split('=').next() == Some(wanted));
    match parameter {
        given if has(given) => None,
        "texts" | "phrases" => Some("text"),
        "threshold" => Some("min_score"),
        "negatives" => Some("negative"),
        "near" | "centre" if has("near_lat_lon") => Some("near_lat_lon"),
        "centre" => Some("near"),
        "polygon" if has("polygon_lat_lon") => Some("polygon_lat_lon"),
        _ => None,
    }
}

/// Returns a function that names refused members as the JSON does.
pub fn as_in_json(ask: &Ask) -> impl Fn(Problem) -> Problem + use<> {
    let of_words = if ask.texts.is_empty() && !ask.phrases.is_empty() { "phrases" } else { "texts" };
    move |mut problem| {
        let name = match problem.parameter() {
            Some("text") => of_words,
            Some("threshold") => "min_score",
            _ => return problem,
        };
        problem.rename_parameter(name);
        problem
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_the_query_string() {
        for (parameter, query, expected) in [
            ("threshold", "text=0&min_score=2", Some("min_score")),
            ("threshold", "text=0&threshold=2", None),
            ("negatives", "text=0&negative=%3F", Some("negative")),
            ("negatives", "negatives=%3F&text=0", None),
            ("texts", "text=0&text=1", Some("text")),
            ("texts", "text=0&texts=1", None),
            ("near", "near_lat_lon=47,8", Some("near_lat_lon")),
            ("near", "text=0&radius=3", None),
            ("centre", "near=0,0,0&radius=3", Some("near")),
            ("centre", "near_lat_lon=47,8&radius=3", Some("near_lat_lon")),
            ("polygon", "polygon_lat_lon=1,2", Some("polygon_lat_lon")),
            ("polygon", "polygon=1,2", None),
            ("limit", "limit=0", None),
        ] {
            assert_eq!(in_query(parameter, query), expected, "{parameter} of {query}");
        }
    }
}
