//! Which shard tells where a photo was taken.

use slag_common::View;
use slag_common::photo_poses::BuiltPhotoPoses;

use crate::cells::CellSplit;

/// Returns the photos of each cell: a photo belongs to the cell whose Gaussians' means are nearest to its camera, the first of
/// such cells, so a robot has the cameras of the area that it fetched and no photo twice.
pub fn photo_poses(split: &CellSplit, views: &[&View]) -> Vec<BuiltPhotoPoses> {
    let mut of_cells = vec![BuiltPhotoPoses::default(); split.cells.len()];
    for view in views {
        let at = view.camera_from_world.inverse().translation;
        let distances = split.cells.iter().map(|cell| cell.mean_bounds.distance_to(at));
        let nearest = distances.enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((cell, _)) = nearest {
            of_cells[cell].push(split.cells[cell].mean_bounds.min, view);
        }
    }
    of_cells
}
