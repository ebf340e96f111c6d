//! The view and the cell that cost most.

use crate::encode::{CellReport, EncodeSummary, ViewsReport};

/// Returns the line that names the most expensive view and cell.
pub(super) fn most_spent(summary: &EncodeSummary) -> String {
    let (views, cells) = (&summary.views, &summary.cells);
    let most = (0..views.view.len()).max_by(|a, b| views.secs[*a].total_cmp(&views.secs[*b]));
    let (Some(at), Some(cell)) = (most, cells.iter().max_by_key(|cell| cell.n_centroids)) else {
        return String::new();
    };
    let ViewsReport { view, raster_width_px, n_masks, n_regions, n_entries, secs } = views;
    let CellReport { cell_id, n_gaussians, n_centroids, .. } = cell;
    format!(
        "most on    view {}, {:.1} s ({} masks, {} regions, {} contributions, {} px wide); cell {cell_id}, {n_centroids} centroids \
         ({n_gaussians} Gaussians)\n",
        view[at], secs[at], n_masks[at], n_regions[at], n_entries[at], raster_width_px[at]
    )
}
