//! The figures of `bench lift`.

use std::fmt;

use serde::Serialize;
use slag_common::ByteSize;

use super::options::LiftOptions;
use crate::bench::machine::Machine;
use crate::bench::timing::Spread;

/// One step, over all repeats.
#[derive(Clone, Debug, Serialize)]
pub struct Step {
    /// Its name.
    pub name: &'static str,
    /// Wall-clock milliseconds.
    pub time: Spread,
    /// Milliseconds of processor time, median over the repeats; less affected by other load than wall-clock time.
    pub cpu_ms: f64,
    /// Nanoseconds per entry, median.
    pub ns_per_entry: f64,
    /// Bytes per entry that the step reads from the page cache or memory.
    pub bytes_read_per_entry: f64,
    /// Bytes per entry that the step leaves in memory.
    pub bytes_made_per_entry: f64,
}

/// Estimated cost of a scene of another size, from the figures of this run.
#[derive(Clone, Debug, Serialize)]
pub struct Plan {
    /// Gaussians.
    pub n_gaussians: usize,
    /// Views, each with as many entries as here.
    pub n_views: usize,
    /// Entries of all views.
    pub n_entries: u64,
    /// Bytes of the files of contributions, read once.
    pub disk_bytes: u64,
    /// Bytes of mask vectors, regions and index.
    pub index_bytes: u64,
    /// Bytes of the largest cell's embeddings, codebook and shard.
    pub cell_bytes: u64,
    /// Bytes that `--memory` leaves for the contributions of a group of cells.
    pub group_bytes: u64,
    /// Seconds of one processor to open, read and transpose.
    pub aggregation_cpu_secs: f64,
    /// Seconds of one processor to compute the embeddings.
    pub embeddings_cpu_secs: f64,
}

/// The figures.
#[derive(Clone, Debug, Serialize)]
pub struct LiftReport {
    /// The machine.
    pub machine: Machine,
    /// The settings.
    pub options: LiftOptions,
    /// Entries of all views.
    pub n_entries: u64,
    /// Gaussians with a contribution per view, as generated.
    pub visible_per_view: f64,
    /// Regions of all views.
    pub n_regions: usize,
    /// Cells.
    pub n_cells: usize,
    /// Groups of cells, each read and transposed at once.
    pub n_groups: usize,
    /// Gaussians with an embedding.
    pub n_with_evidence: usize,
    /// Bytes of the files of contributions.
    pub disk_bytes: u64,
    /// Seconds to generate and write them; not part of the aggregation.
    pub write_secs: f64,
    /// The steps.
    pub steps: Vec<Step>,
    /// From files of contributions to contributions by Gaussian with total weights: open, read, transpose.
    pub aggregation: Spread,
    /// The same with each Gaussian's embedding and its length.
    pub with_embeddings: Spread,
    /// Cost model of the embeddings.
    pub embedding_model: EmbeddingModel,
    /// Peak memory of the process during the aggregation.
    pub peak_rss_bytes: Option<u64>,
    /// Memory of the process before the aggregation.
    pub rss_before_bytes: Option<u64>,
    /// Estimate for a larger scene.
    pub plan: Plan,
}

/// Processor time of the embeddings: a cost per entry and a cost per Gaussian.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct EmbeddingModel {
    /// Nanoseconds per entry.
    pub ns_per_entry: f64,
    /// Nanoseconds per Gaussian.
    pub ns_per_gaussian: f64,
}

impl fmt::Display for LiftReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let LiftOptions { n_gaussians, n_views, n_masks, dim, .. } = self.options;
        writeln!(
            f,
            "{n_gaussians} Gaussians, {n_views} views of {n_masks} masks, {dim} components: {} entries, {}; {}",
            self.n_entries,
            ByteSize(self.disk_bytes),
            self.machine.cpu
        )?;
        for step in &self.steps {
            writeln!(
                f,
                "{:<42} {:>9.0} ms  {:>6.2} ns per entry  {:>9.0} ms of processor time",
                step.name, step.time.median_ms, step.ns_per_entry, step.cpu_ms
            )?;
        }
        writeln!(f, "{:<42} {:>9.0} ms", "aggregation: open, read, transpose", self.aggregation.median_ms)?;
        writeln!(f, "{:<42} {:>9.0} ms", "with embeddings", self.with_embeddings.median_ms)?;
        if let Some(peak) = self.peak_rss_bytes {
            writeln!(
                f,
                "{:<42} {:>12} of {}",
                "peak memory",
                ByteSize(peak),
                ByteSize(self.options.memory_bytes)
            )?;
        }
        let plan = &self.plan;
        writeln!(
            f,
            "estimate for {} Gaussians, {} views: {} entries, {} on disk read once, none written; \
             aggregation {:.1} s and embeddings {:.1} s of one processor; memory {} for the index, {} for a cell",
            plan.n_gaussians,
            plan.n_views,
            plan.n_entries,
            ByteSize(plan.disk_bytes),
            plan.aggregation_cpu_secs,
            plan.embeddings_cpu_secs,
            ByteSize(plan.index_bytes),
            ByteSize(plan.cell_bytes)
        )
    }
}
