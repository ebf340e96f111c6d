//! Spatial search over the cells of a manifest.

use super::records::CellRecord;
use crate::frames::Aabb;

pub struct CellIndex {
    tree: rstar::RTree<IndexedCell>,
}

struct IndexedCell {
    position: usize,
    bounds: Aabb,
}

impl rstar::RTreeObject for IndexedCell {
    type Envelope = rstar::AABB<[f64; 3]>;

    fn envelope(&self) -> Self::Envelope {
        rstar::AABB::from_corners(self.bounds.min.to_array(), self.bounds.max.to_array())
    }
}

impl rstar::PointDistance for IndexedCell {
    fn distance_2(&self, point: &[f64; 3]) -> f64 {
        self.bounds.distance_to((*point).into()).powi(2)
    }
}

impl CellIndex {
    /// Bulk load, O(n log n).
    pub fn new<'a>(cells: impl IntoIterator<Item = &'a CellRecord>) -> Self {
        let indexed = cells
            .into_iter()
            .enumerate()
            .map(|(position, cell)| IndexedCell { position, bounds: cell.bounds });
        Self { tree: rstar::RTree::bulk_load(indexed.collect()) }
    }

    /// Returns the positions of the cells whose box is within a radius of a point, ascending.
    pub fn within(&self, centre_in_world: glam::DVec3, radius: f64) -> Vec<usize> {
        let found = self.tree.locate_within_distance(centre_in_world.to_array(), radius * radius);
        let mut positions: Vec<usize> = found.map(|cell| cell.position).collect();
        positions.sort_unstable();
        positions
    }
}
