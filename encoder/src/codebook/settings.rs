//! How fine a codebook is.

use super::basis::MAX_COMPONENTS;

/// How fine a codebook is. Errors are means of `|score error|`, relative to the spread of scores (their
/// standard deviation over the scene).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct CodebookSettings {
    /// Largest accepted error of the compact profile.
    pub compact_error: f32,
    /// Largest accepted error of the balanced profile.
    pub balanced_error: f32,
    /// Most components of a centroid: the dimension of compact and balanced shards. Fewer are taken where the errors
    /// allow it; even, 2 to [`MAX_COMPONENTS`].
    pub max_components: usize,
    /// Fewest Gaussians per centroid, on average.
    pub min_gaussians_per_centroid: usize,
    /// Bytes per Gaussian that centroids of outliers may take, beside a sixteenth of the basis: they lower the hard bound
    /// of scores. 0: no such centroids.
    pub outlier_bytes: f32,
    /// Most subspaces of the residual code (half a byte each); below 2 there is no code.
    pub max_subspaces: usize,
    /// Whether residuals are also stored in 8 bits per component, as in exact shards.
    pub has_fine: bool,
}

impl Default for CodebookSettings {
    /// On the labelled house, 0.1 keeps the exact field's task accuracy, and 0.02 its ranking (README.md).
    fn default() -> Self {
        Self {
            compact_error: 0.1,
            balanced_error: 0.02,
            max_components: MAX_COMPONENTS,
            min_gaussians_per_centroid: 45,
            outlier_bytes: 0.25,
            max_subspaces: 32,
            has_fine: false,
        }
    }
}
