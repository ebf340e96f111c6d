//! Cost and accuracy of a point of the grid.

use serde::{Deserialize, Serialize};

use super::grid::Point;

/// Cost and accuracy of a point.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// The scene.
    pub scene: String,
    /// The point.
    #[serde(flatten)]
    pub point: Point,
    /// Models, device and version; figures of others are not comparable.
    pub made_by: String,
    /// Views used.
    pub n_views: u64,
    /// Views of the scene with a photo, before any were chosen.
    pub n_photos: u64,
    /// Gaussians in cells.
    pub n_gaussians: u64,
    /// Masks used.
    pub n_masks: u64,
    /// Coverage by the chosen views relative to all views, where views were chosen by coverage.
    pub coverage: Option<f64>,
    /// Multi-class intersection over union, mean over the categories.
    pub miou: f64,
    /// Multi-class accuracy, mean over the categories.
    pub macc: f64,
    /// Mean average precision.
    pub map: Option<f64>,
    /// Mean area under the ROC curve.
    pub auc: Option<f64>,
    /// Share of views on which the best pixel lies on the thing.
    pub localised: Option<f64>,
    /// Intersection over union on test views.
    pub iou_on_views: Option<f64>,
    /// Words that the encoder does not know; no mean counts them.
    pub n_unknown_words: u64,
    /// Seconds of the encode.
    pub seconds: f64,
    /// Seconds of these for the views.
    pub views_seconds: f64,
    /// Seconds of these for choosing the views.
    pub coverage_seconds: f64,
    /// Bytes per Gaussian in the profile's shards.
    pub bytes_per_gaussian: f64,
    /// Milliseconds of a query for the best thousand, median; absent without slag-edge.
    pub query_ms: Option<f64>,
}
