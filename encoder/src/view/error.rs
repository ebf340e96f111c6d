//! Why the page gets no answer.

use axum::http::StatusCode;
use slag_models::InferenceError;
use slag_service::problem::Problem;

use crate::store::StoreError;

#[derive(Debug, thiserror::Error)]
pub(crate) enum ViewError {
    #[error("only a splat is shown, which cannot be asked; encode it, and give its store with --store")]
    NoStore,
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error(
        "the splat has {found} Gaussians, but the store was encoded from one with {expected}; give that one with --scene"
    )]
    OtherSplat { expected: u64, found: usize },
    #[error("there is no cell {cell_id} of this generation; GET /v1/view lists the cells")]
    NoCell { cell_id: u32 },
    #[error("the store has one generation alone; encode again into it, and what changed is shown")]
    OneGeneration,
    #[error("{0}")]
    Models(String),
    #[error(transparent)]
    Text(#[from] InferenceError),
}

impl From<ViewError> for Problem {
    fn from(error: ViewError) -> Self {
        let (status, kind, title) = match &error {
            ViewError::NoStore => (StatusCode::NOT_FOUND, "no-store", "No store"),
            ViewError::NoCell { .. } => (StatusCode::NOT_FOUND, "no-such-cell", "No such cell"),
            ViewError::Text(
                InferenceError::EmptyText | InferenceError::SeveralThings(_) | InferenceError::Comparison(_),
            ) => (StatusCode::BAD_REQUEST, "bad-parameter", "Bad parameter"),
            ViewError::Text(InferenceError::UnknownPhrase { .. } | InferenceError::UnknownWords { .. }) => {
                (StatusCode::UNPROCESSABLE_ENTITY, "unknown-words", "Unknown words")
            }
            ViewError::OneGeneration => (StatusCode::CONFLICT, "one-generation", "One generation"),
            ViewError::Store(StoreError::NotComparable(_)) => {
                (StatusCode::CONFLICT, "not-comparable", "Not comparable")
            }
            ViewError::Models(_) => (StatusCode::CONFLICT, "encoder-mismatch", "No text model"),
            ViewError::OtherSplat { .. } => (StatusCode::CONFLICT, "other-splat", "Another splat"),
            ViewError::Store(StoreError::NotPublished { .. } | StoreError::ManifestLost { .. }) => {
                (StatusCode::SERVICE_UNAVAILABLE, "no-scene", "No scene")
            }
            _ => return Self::internal(slag_common::error_line(&error)),
        };
        Self::new(status, kind, title, error.to_string())
    }
}
