//! Why a request has no reply.

use crate::query::{QueryError, RequestError};
use crate::score::{OverBudget, ScoreError};

/// Why a request has no reply.
#[derive(Debug, thiserror::Error)]
pub enum GoalError {
    #[error(transparent)]
    Query(#[from] QueryError),
    #[error(
        "the scene does not say which places are free; encode it with --occupancy, publish it, and fetch it again"
    )]
    NoOccupancy,
    #[error(
        "the scene has no objects to go to; encode it without --no-objects, publish it, and fetch it again"
    )]
    NoObjects,
}

impl From<RequestError> for GoalError {
    fn from(error: RequestError) -> Self {
        Self::Query(error.into())
    }
}

impl GoalError {
    pub(super) fn spent(error: OverBudget) -> Self {
        Self::Query(ScoreError::from(error).into())
    }

    /// Returns the stable name of the error's kind, for programs.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Query(error) => error.kind(),
            Self::NoOccupancy => "no-occupancy",
            Self::NoObjects => "no-objects",
        }
    }
}
