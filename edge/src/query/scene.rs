//! The data that a query runs on.

use glam::DVec3;
use slag_api::UNITS;
use slag_api::coverage::{BadCellAnswer, Coverage};
use slag_api::objects::Alignment;
use slag_common::manifest::{CellRecord, Manifest};
use slag_common::objects::Objects;
use slag_common::shard::ShardView;
use slag_math::stats::median;

use crate::score::Region;
use crate::store::objects::ObjectIndex;
use crate::store::{BadCell, Snapshot, cell_of};

/// Voxel edge in a metric scene, metres: parts of a piece of furniture are within two edges, two pieces mostly not.
const METRIC_VOXEL_M: f64 = 0.25;
/// Voxels per middle edge of the median cell, in a non-metric scene.
const VOXELS_PER_CELL: f64 = 64.0;

pub struct Scene<'a> {
    pub shards: Vec<ShardView<'a>>,
    /// The objects of each shard; absent in shards without them.
    pub objects: Vec<Option<Objects<'a>>>,
    pub index: &'a ObjectIndex,
    pub manifest: &'a Manifest,
    /// Cells without a shard on board.
    pub not_fetched: Vec<&'a CellRecord>,
    /// Cells whose shards could not be fetched.
    pub bad_cells: &'a [BadCell],
}

impl<'a> Scene<'a> {
    pub fn of(snapshot: &'a Snapshot) -> Self {
        Self {
            shards: snapshot.shards.iter().map(|shard| shard.view()).collect(),
            objects: snapshot.shards.iter().map(|shard| shard.additions().objects).collect(),
            index: &snapshot.objects,
            manifest: &snapshot.manifest,
            not_fetched: snapshot.not_fetched().collect(),
            bad_cells: &snapshot.bad_cells,
        }
    }

    /// Returns how much of a region is on board.
    pub(crate) fn coverage(&self, region: &Region) -> Coverage {
        let touches = |bad: &&BadCell| {
            cell_of(self.manifest, bad.cell_id).is_none_or(|cell| region.touches(&cell.bounds))
        };
        let described = |bad: &BadCell| BadCellAnswer {
            cell_id: bad.cell_id,
            generation: bad.old.map(|old| old.generation),
        };
        let bad_cells: Vec<BadCellAnswer> = self.bad_cells.iter().filter(touches).map(described).collect();
        let is_bad = |cell_id: u32| self.bad_cells.iter().any(|bad| bad.cell_id == cell_id);
        let lacks = |cell: &&&CellRecord| region.touches(&cell.bounds) && !is_bad(cell.cell_id);
        let n_cells_not_fetched = self.not_fetched.iter().filter(lacks).count() as u64;
        let are_there = bad_cells.iter().all(|bad| bad.generation.is_some());
        Coverage { area_fetched: Some(n_cells_not_fetched == 0 && are_there), n_cells_not_fetched, bad_cells }
    }
}

pub fn unit(manifest: &Manifest) -> &'static str {
    UNITS[usize::from(!manifest.metric)]
}

/// Returns the default edge of the voxels: 0.25 m in a metric scene, else a 64th of the median cell's middle edge
/// (sky and ground make the longest and shortest edges meaningless).
pub fn default_voxel(manifest: &Manifest) -> f64 {
    if manifest.metric {
        return METRIC_VOXEL_M;
    }
    let middle = |size: DVec3| size.x.max(size.y).min(size.x.max(size.z)).min(size.y.max(size.z));
    let mut edges: Vec<f64> = manifest.cells.iter().map(|cell| middle(cell.bounds.size())).collect();
    let voxel = median(&mut edges).map_or(0.0, |edge| edge / VOXELS_PER_CELL);
    if voxel > 0.0 && voxel.is_finite() { voxel } else { 1.0 }
}

/// Returns the permitted box orientations: a metric or geo-referenced world has z up (`frames.rs`).
pub(super) fn alignment(manifest: &Manifest) -> Alignment {
    let z_is_up = manifest.metric || manifest.geo_reference.is_some();
    if z_is_up { Alignment::Gravity } else { Alignment::Principal }
}
