//! Which places are free, occupied or unknown, for robots that move. The definition is in `docs/numerics.md`.

mod density;
mod owners;
mod seen;

use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;
use slag_common::occupancy::{Block, BuiltOccupancy};
use slag_common::{Gaussians, View};

use crate::cells::{CellSplit, NO_CELL};
use crate::memory::{MemoryError, MemoryPlan, Phase};
use crate::raster::{LoadedScene, RasterError, RasterView};
use owners::Lattice;
use seen::Candidate;

pub use density::MIN_OPACITY;
pub(crate) use seen::MIN_VIEWS;

/// How places are told apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OccupancySettings {
    pub(crate) voxel_m: f64,
}

pub struct SceneOccupancy {
    pub cells: Vec<BuiltOccupancy>,
    pub report: OccupancyReport,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct OccupancyReport {
    pub(crate) voxel_m: f64,
    pub(crate) n_occupied: u64,
    /// Voxels that views have looked through.
    pub n_free: u64,
    /// Gaussians too large to be a thing, which were left out.
    pub(crate) n_background: usize,
    /// Bytes of all cells, in each profile.
    pub len_bytes: u64,
    pub secs: f64,
}

impl SceneOccupancy {
    /// Reserves what is held until the last shard is written.
    pub(crate) fn reserve(&self, memory: &mut MemoryPlan) {
        memory.reserve(Phase::Always, "free and occupied places", self.report.len_bytes);
    }
}

/// Bytes per candidate: with what was seen there, and as a block both in the list of all and in its cell's.
const BYTES_PER_CANDIDATE: u64 = (size_of::<Candidate>() + 2 * size_of::<Block>()) as u64;

#[derive(Debug, thiserror::Error)]
pub(crate) enum OccupancyError {
    #[error(transparent)]
    Memory(#[from] MemoryError),
    /// The view of this index cannot be drawn.
    #[error("view {0}: {1}")]
    View(usize, RasterError),
}

/// Finds free and occupied places from a scene's Gaussians and views, within `memory`; `None` if cancelled.
pub(crate) fn find(
    gaussians: &Gaussians,
    split: &CellSplit,
    scene: &dyn LoadedScene,
    views: &[&View],
    settings: OccupancySettings,
    mut memory: MemoryPlan,
    cancel: &AtomicBool,
) -> Result<Option<SceneOccupancy>, OccupancyError> {
    let start = std::time::Instant::now();
    let lattice = Lattice { voxel: settings.voxel_m };
    let in_cells = (0u32..).zip(&split.cell_of_gaussian).filter(|(_, cell)| **cell != NO_CELL);
    let usable: Vec<u32> = in_cells.map(|(index, _)| index).collect();
    let lists_bytes = density::working_bytes(gaussians, &usable, lattice);
    memory.reserve(Phase::Occupancy, "the voxels of each Gaussian", lists_bytes);
    memory.rest(0)?;
    let occupied = density::occupied(gaussians, &usable, lattice);
    let n_candidates = seen::candidates(&occupied.blocks, lattice).count() as u64;
    memory.reserve(Phase::Occupancy, "places that may be free", n_candidates * BYTES_PER_CANDIDATE);
    memory.rest(0)?;
    let mut candidates: Vec<Candidate> = Vec::with_capacity(n_candidates as usize);
    candidates.extend(seen::candidates(&occupied.blocks, lattice));
    for (at, view) in views.iter().enumerate() {
        if cancel.load(Ordering::Relaxed) {
            return Ok(None);
        }
        let width_px = seen::DEPTH_WIDTH_PX.min(view.intrinsics.width_px);
        let intrinsics = view.intrinsics.without_distortion().scaled_to_width(width_px);
        let view = RasterView { camera_from_world: view.camera_from_world, intrinsics };
        let drawing = scene.draw(&view, [0.0; 3]).map_err(|source| OccupancyError::View(at, source))?;
        seen::Depth::new(view, &drawing).look(lattice, &mut candidates);
    }
    let blocks: Vec<Block> = candidates
        .iter()
        .map(|block| Block { at: block.at, occupied: block.occupied, free: block.seen & !block.occupied })
        .filter(|block| block.occupied | block.free != 0)
        .collect();
    drop(candidates);
    let of_cell = owners::by_cell(&blocks, split, lattice);
    let pack = |blocks: &Vec<Block>| BuiltOccupancy::pack(settings.voxel_m, MIN_OPACITY, MIN_VIEWS, blocks);
    let cells: Vec<BuiltOccupancy> = of_cell.iter().map(pack).collect();
    let report = OccupancyReport {
        voxel_m: settings.voxel_m,
        n_occupied: blocks.iter().map(|block| u64::from(block.occupied.count_ones())).sum(),
        n_free: blocks.iter().map(|block| u64::from(block.free.count_ones())).sum(),
        n_background: occupied.n_background,
        len_bytes: cells.iter().map(BuiltOccupancy::len_bytes).sum(),
        secs: start.elapsed().as_secs_f64(),
    };
    Ok(Some(SceneOccupancy { cells, report }))
}
