//! Errors of this service.

use std::time::Duration;

use axum::http::StatusCode;
use schemars::JsonSchema;
use serde::Serialize;
use slag_common::Hash32;
use slag_models::InferenceError;
use slag_service::params::ParameterMembers;
use slag_service::problem::Problem;

use crate::query::{NO_SUCH_GENERATION, QueryError, RequestError};
use crate::score::OverBudget;
use crate::text::TextError;

/// `Retry-After` of requests beyond a limit.
const RETRY_SECS: u32 = 1;
/// `Retry-After` while a failed follower restarts.
const FOLLOWER_RETRY_SECS: u32 = 5;

/// Errors of routes that read the scene.
pub const FAILED: (u16, &str) = (500, "The service failed.");
pub const NO_SCENE: (u16, &str) = (
    503,
    "No scene is loaded, too much is asked at once, or the answer took too long; Retry-After has the pause before the next attempt.",
);
/// Errors of routes that use the text model.
pub const OTHER_MODEL: (u16, &str) = (409, "The text model does not fit the scene.");
pub const WORDS: (u16, &str) =
    (422, "The text model does not know the words, or the answer needs more memory or time than its budget.");
/// Error of routes that take a time budget.
pub const TIME_BUDGET: (u16, &str) = (504, "The time that the request gives is spent.");
/// Error of routes with a budget of memory and time.
pub const BUDGET: (u16, &str) = (422, "The answer needs more memory or time than its budget.");
/// Error of routes that need occupancy.
pub const NO_PLACES: (u16, &str) =
    (409, "No shard on board says which places are free, or the scene has no objects.");

/// What this service's problems tell beyond RFC 9457.
#[derive(Default, Serialize, JsonSchema)]
pub struct Members {
    #[serde(flatten)]
    parameter: ParameterMembers,
    /// Words that the model knows.
    #[serde(skip_serializing_if = "Option::is_none")]
    suggestions: Option<Vec<String>>,
    /// The text model.
    #[serde(skip_serializing_if = "Option::is_none")]
    models: Option<EncoderName>,
    /// The scene's encoder.
    #[serde(skip_serializing_if = "Option::is_none")]
    scene: Option<EncoderName>,
}

/// An encoder.
#[derive(Serialize, JsonSchema)]
struct EncoderName {
    /// Its name.
    name: String,
    /// Its id.
    id: Hash32,
}

pub fn overloaded(limit: usize) -> Problem {
    Problem::overloaded(format!("{limit} queries are in progress, the limit; ask again"), RETRY_SECS)
}

pub fn too_many_listeners(limit: usize) -> Problem {
    Problem::overloaded(format!("{limit} clients listen to events, the limit; ask again"), RETRY_SECS)
}

pub fn timeout(limit: Duration) -> Problem {
    let detail = format!("no answer within {} s; ask for a smaller radius, or again", limit.as_secs_f64());
    Problem::timeout(detail, RETRY_SECS)
}

/// The client's own time budget is spent; asking again does not help.
pub fn out_of_time(given: Duration) -> Problem {
    let detail = format!(
        "no answer within the {} s that the request gives; give it more, or ask for a smaller region",
        given.as_secs_f64()
    );
    Problem::new(StatusCode::GATEWAY_TIMEOUT, "time-budget", "Time budget spent", detail)
}

pub fn not_following() -> Problem {
    let detail = "positions are not followed; start the service with --follow URL";
    Problem::new(StatusCode::CONFLICT, "not-following", "Not following", detail)
}

pub fn follower_failed(failure: &str) -> Problem {
    let detail = format!(
        "positions are kept but not followed just now: {failure}; following starts again by itself, the log has more"
    );
    Problem::new(StatusCode::SERVICE_UNAVAILABLE, "follower-failed", "Follower failed", detail)
        .retry_after(FOLLOWER_RETRY_SECS)
}

impl From<OverBudget> for Problem {
    fn from(error: OverBudget) -> Self {
        QueryError::from(error).into()
    }
}

impl From<QueryError> for Problem {
    fn from(error: QueryError) -> Self {
        let (kind, detail) = (error.kind(), error.to_string());
        let refused = |status, title| Self::new(status, kind, title, detail.clone());
        let unavailable = |title| refused(StatusCode::SERVICE_UNAVAILABLE, title).retry_after(RETRY_SECS);
        let parameter = if matches!(error, QueryError::Negatives(_)) { "negatives" } else { "text" };
        let unknown_words = |found: String, expected: String, suggestions: Vec<String>| {
            let parameter = ParameterMembers {
                parameter: Some(parameter.into()),
                found: Some(found),
                expected: Some(expected),
            };
            let members = Members { parameter, suggestions: Some(suggestions), ..Members::default() };
            refused(StatusCode::UNPROCESSABLE_ENTITY, "Unknown words").with(&members)
        };
        match error {
            QueryError::Request(error) => error.into(),
            QueryError::NoScene => unavailable("No scene"),
            QueryError::Unable { kind: NO_SUCH_GENERATION, title, .. } => {
                refused(StatusCode::NOT_FOUND, title)
            }
            QueryError::Unable { title, .. } => refused(StatusCode::CONFLICT, title),
            QueryError::EncoderMismatch { models_name, models_id, scene_name, scene_id } => {
                let members = Members {
                    models: Some(EncoderName { name: models_name, id: models_id }),
                    scene: Some(EncoderName { name: scene_name, id: scene_id }),
                    ..Members::default()
                };
                refused(StatusCode::CONFLICT, "Text model does not fit the scene").with(&members)
            }
            QueryError::Text(TextError::Encode(error)) | QueryError::Negatives(TextError::Encode(error)) => {
                match error {
                    InferenceError::EmptyText => {
                        RequestError::new(parameter, "nothing to look for", "words to look for").into()
                    }
                    InferenceError::SeveralThings(named) => {
                        RequestError::new(parameter, &named.join(", "), "one thing alone").into()
                    }
                    InferenceError::UnknownPhrase { text, n_known, near } => {
                        unknown_words(text, format!("one of {n_known} phrases"), near)
                    }
                    InferenceError::UnknownWords { unknown, known } => {
                        unknown_words(unknown.join(", "), "words that the model knows".into(), known)
                    }
                    _ => Self::internal(&detail),
                }
            }
            QueryError::Text(_) | QueryError::Negatives(_) | QueryError::Score(_) => match kind {
                "overloaded" => unavailable("Overloaded"),
                "over-budget" => refused(StatusCode::UNPROCESSABLE_ENTITY, "Over budget"),
                _ => Self::internal(&detail),
            },
        }
    }
}
