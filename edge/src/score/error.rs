//! Errors of scoring.

use super::budget::OverBudget;

/// Largest coordinate of a scene, world units. Larger ones (a hundred times the earth's diameter) are
/// refused, because computations with them would overflow.
pub const MAX_COORDINATE: f64 = 1e9;

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScoreError {
    /// The question needs more than its budget.
    #[error(transparent)]
    OverBudget(#[from] OverBudget),
    /// The query vector has another dimension than the shard.
    #[error(
        "cell {cell_id} holds embeddings of {expected} components, but the query vector has {found}; use the models that the scene was encoded with"
    )]
    Dimension {
        cell_id: u32,
        /// Components of the shard.
        expected: usize,
        /// Components of the query.
        found: usize,
    },
    /// The query vector is not of unit length, or not finite.
    #[error(
        "the query vector has length {found}, expected 1; the text model is damaged or does not normalise its vectors"
    )]
    NotUnit { found: f32 },
    /// A negative has another dimension than the question.
    #[error(
        "a negative has {found} components, but the query vector has {expected}; encode both with the same text model"
    )]
    Negative {
        /// Components of the query.
        expected: usize,
        /// Components of the negative.
        found: usize,
    },
    /// A shard's positions exceed [`MAX_COORDINATE`].
    #[error(
        "cell {cell_id}: positions reach {found:e}, the limit is {MAX_COORDINATE:e} world units; encode the scene again around a nearer origin"
    )]
    Extent { cell_id: u32, found: f64 },
}
