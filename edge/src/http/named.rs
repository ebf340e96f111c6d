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
pub fn as_in_json(ask: Option<&Ask>) -> impl Fn(Problem) -> Problem + use<> {
    let has_phrases_alone = ask.is_some_and(|ask| ask.texts.is_empty() && !ask.phrases.is_empty());
    let of_words = if has_phrases_alone { "phrases" } else { "texts" };
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
