//! Errors of an evaluation.

use slag_common::Gaussians;
use slag_encoder::query::QueryError;
use slag_encoder::raster::RasterError;
use slag_encoder::store::StoreReader;
use slag_models::InferenceError;

use super::scan::ScanError;
use super::truth::TruthError;

/// Error of an evaluation.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// The labels cannot be used.
    #[error(transparent)]
    Truth(#[from] TruthError),
    /// The splat is not the one that was encoded.
    #[error("the store has {n_store} Gaussians, the splat {n_scene}; give the splat that was encoded")]
    Scene {
        /// Gaussians in the store.
        n_store: usize,
        /// Gaussians in the splat.
        n_scene: usize,
    },
    /// The scan cannot be used.
    #[error(transparent)]
    Scan(#[from] ScanError),
    /// The store cannot be scored.
    #[error(transparent)]
    Query(#[from] QueryError),
    /// A view cannot be drawn.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// The encoder knows none of the words.
    #[error("the encoder knows none of {n} words ({first}: {source}); give others with --words")]
    NoWords {
        /// Number of words tried.
        n: usize,
        /// The first word.
        first: String,
        /// Its error.
        source: Box<InferenceError>,
    },
    /// No word is a category of the scene.
    #[error("none of the words is a category of the labels; the categories are: {categories}")]
    NoCategories {
        /// The categories.
        categories: String,
    },
}

/// Returns an error unless the splat has as many Gaussians as the store.
pub(super) fn check_scene(reader: &StoreReader, scene: &Gaussians) -> Result<(), EvalError> {
    let manifest = reader.manifest();
    let n_store = (manifest.n_gaussians + manifest.n_rejected) as usize;
    if n_store != scene.len() { Err(EvalError::Scene { n_store, n_scene: scene.len() }) } else { Ok(()) }
}
