//! Settings of `bench lift`.

use std::path::PathBuf;

use serde::Serialize;
use slag_encoder::shard;

/// Settings of `bench lift`.
#[derive(Clone, Debug, Serialize)]
pub struct LiftOptions {
    /// Gaussians.
    pub n_gaussians: usize,
    /// Views.
    pub n_views: usize,
    /// Masks per view.
    pub n_masks: usize,
    /// Gaussians with a contribution, per view.
    pub n_visible: usize,
    /// Mean contributions of each of these.
    pub entries_per_visible: f64,
    /// Components of an embedding.
    pub dim: usize,
    /// Gaussians per cell at most.
    pub cell_gaussians: usize,
    /// Working memory, as with `encode --memory`.
    pub memory_bytes: u64,
    /// Repeats.
    pub n_repeats: usize,
    /// Folder for the files of contributions; created if absent.
    pub work_dir: PathBuf,
    /// Gaussians and views of the scene to estimate.
    pub plan: (usize, usize),
}

impl LiftOptions {
    pub(super) fn paths(&self) -> Vec<PathBuf> {
        (0..self.n_views).map(|view| self.work_dir.join(format!("{view:05}.contributions"))).collect()
    }

    pub(super) fn group_bytes(&self, index_bytes: u64) -> u64 {
        let cell_bytes = shard::working_bytes(self.cell_gaussians.min(self.n_gaussians), self.dim);
        self.memory_bytes.saturating_sub(cell_bytes + index_bytes)
    }
}
