//! Errors of scoring.

use super::budget::OverBudget;

/// Largest coordinate of a scene, world units. Larger ones (a hundred times the earth's diameter) are
/// refused, because computations with them would overflow.
pub const MAX_COORDINATE: f64 = 1e9;

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScoreError {
    #[error(transparent)]
    OverBudget(#[from] OverBudget),
    #[error(
        "cell {cell_id} holds embeddings of {expected} components, but the query vector has {found}; use the models that the scene was encoded with"
    )]
    Dimension { cell_id: u32, expected: usize, found: usize },
    #[error(
        "the query vector has length {found}, expected 1; the text model is damaged or does not normalise its vectors"
    )]
    NotUnit { found: f32 },
    #[error(
        "a negative has {found} components, but the query vector has {expected}; encode both with the same text model"
    )]
    Negative { expected: usize, found: usize },
    #[error(
        "cell {cell_id}: positions reach {found:e}, the limit is {MAX_COORDINATE:e} world units; encode the scene again around a nearer origin"
    )]
    Extent { cell_id: u32, found: f64 },
}
