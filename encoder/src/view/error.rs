//! Why the page gets no answer.

use axum::http::StatusCode;
use slag_common::container::ContainerError;
use slag_models::InferenceError;
use slag_service::problem::Problem;

use crate::diff::DiffError;
use crate::lift::published::ReadFieldError;
use crate::store::StoreError;

/// Why the page gets no answer.
#[derive(Debug, thiserror::Error)]
pub enum ViewError {
    /// A splat alone is shown.
    #[error("only a splat is shown, which cannot be asked; encode it, and give its store with --store")]
    NoStore,
    /// The store cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A field cannot be read.
    #[error(transparent)]
    Field(#[from] ReadFieldError),
    /// A shard is damaged.
    #[error("cell {cell_id}: {source}; encode again: what is damaged is written anew")]
    Shard {
        /// The cell.
        cell_id: u32,
        /// The damage.
        source: ContainerError,
    },
    /// The splat is not the store's.
    #[error(
        "the splat has {found} Gaussians, but the store was encoded from one with {expected}; give that one with --scene"
    )]
    OtherSplat {
        /// Gaussians of the splat that the store was encoded from.
        expected: u64,
        /// Gaussians of the splat that was given.
        found: usize,
    },
    /// There is no such cell.
    #[error("there is no cell {cell_id} of this generation; GET /v1/view lists the cells")]
    NoCell {
        /// The cell.
        cell_id: u32,
    },
    /// There is nothing to compare with.
    #[error("the store has one generation alone; encode again into it, and what changed is shown")]
    OneGeneration,
    /// Two generations cannot be compared.
    #[error(transparent)]
    Changes(#[from] DiffError),
    /// The text model cannot be opened.
    #[error("{0}")]
    Models(String),
    /// The text cannot be encoded.
    #[error(transparent)]
    Text(#[from] InferenceError),
}

impl From<ViewError> for Problem {
    fn from(error: ViewError) -> Self {
        let (status, kind, title) = match &error {
            ViewError::NoStore => (StatusCode::NOT_FOUND, "no-store", "No store"),
            ViewError::NoCell { .. } => (StatusCode::NOT_FOUND, "no-such-cell", "No such cell"),
            ViewError::Text(InferenceError::EmptyText) => {
                (StatusCode::BAD_REQUEST, "bad-parameter", "Bad parameter")
            }
            ViewError::Text(InferenceError::UnknownPhrase { .. } | InferenceError::UnknownWords { .. }) => {
                (StatusCode::UNPROCESSABLE_ENTITY, "unknown-words", "Unknown words")
            }
            ViewError::OneGeneration => (StatusCode::CONFLICT, "one-generation", "One generation"),
            ViewError::Changes(DiffError::NoObjects { .. } | DiffError::Encoders { .. }) => {
                (StatusCode::CONFLICT, "not-comparable", "Not comparable")
            }
            ViewError::Models(_) => (StatusCode::CONFLICT, "encoder-mismatch", "No text model"),
            ViewError::OtherSplat { .. } => (StatusCode::CONFLICT, "other-splat", "Another splat"),
            ViewError::Store(StoreError::NotPublished { .. }) => {
                (StatusCode::SERVICE_UNAVAILABLE, "no-scene", "No scene")
            }
            _ => return Self::internal(slag_common::error_line(&error)),
        };
        Self::new(status, kind, title, error.to_string())
    }
}
