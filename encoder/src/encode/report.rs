//! What an encode did: the summary that the program prints.

use std::collections::BTreeMap;

use serde::Serialize;

use super::coverage::CoverageReport;
use super::settings::ViewOrder;
use crate::lanes::GpuLoad;
use crate::memory::Phase;
use crate::objects::ObjectsReport;
use crate::occupancy::OccupancyReport;

#[derive(Clone, Debug, Serialize)]
pub struct SkippedView {
    pub view: String,
    pub reason: String,
}

/// Left-out views: the first ones are named as they occur, the others counted.
#[derive(Default)]
pub(crate) struct LeftOut(Vec<SkippedView>);

impl LeftOut {
    const N_NAMED: usize = 3;

    pub(crate) fn push(&mut self, view: String, mut reason: String) {
        // Most errors already name their view.
        if let Some(rest) = reason.strip_prefix(&format!("view {view}: ")) {
            reason = rest.to_owned();
        }
        if self.0.len() < Self::N_NAMED {
            tracing::warn!("view {view} is left out: {reason}");
        }
        self.0.push(SkippedView { view, reason });
    }

    pub(crate) fn end(self) -> Vec<SkippedView> {
        if let Some(n @ 1..) = self.0.len().checked_sub(Self::N_NAMED) {
            tracing::warn!("{n} more views are left out; --json and --report name them");
        }
        self.0
    }
}

/// Kept views that an encode cannot take over, since their splat, models or settings were others.
#[derive(Clone, Debug, Serialize)]
pub struct LostViews {
    pub n_views: usize,
    pub reason: String,
}

#[derive(Clone, Debug, Serialize)]
pub struct CellReport {
    pub cell_id: u32,
    pub n_gaussians: u32,
    /// Contributions: pairs of a Gaussian and a region.
    pub n_entries: u64,
    pub n_centroids: u32,
    /// Subspaces of the residual code, half a byte a Gaussian each; 0 where centroids suffice for every profile.
    pub n_subspaces: u32,
    pub shard_bytes: BTreeMap<String, u64>,
    /// Mean error of their scores, relative to the spread of scores, by profile; absent where they do not differ.
    pub score_error: BTreeMap<String, f32>,
}

/// The cost of each view, a column per figure, in the order of the names.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ViewsReport {
    pub view: Vec<String>,
    /// Width at which weights were rasterised, pixels.
    pub raster_width_px: Vec<u32>,
    pub n_masks: Vec<usize>,
    pub n_regions: Vec<usize>,
    /// Contributions: pairs of a Gaussian and a region.
    pub n_entries: Vec<u64>,
    /// Seconds in all stages but the last, to the millisecond.
    pub secs: Vec<f64>,
}

#[derive(Clone, Debug, Serialize)]
pub struct StageReport {
    pub stage: String,
    /// Views that it takes at once.
    pub(crate) n_slots: usize,
    /// Seconds of work, added over the slots.
    pub(crate) busy_secs: f64,
    /// Mean share of the time in which its slots were busy, 0 to 1.
    pub busy_share: f64,
    /// The load of each GPU that runs the stage's models; empty on the processor.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub gpus: Vec<GpuReport>,
}

#[derive(Clone, Debug, Serialize)]
pub struct GpuReport {
    #[serde(flatten)]
    pub(crate) load: GpuLoad,
    /// The share of the time in which it was busy, 0 to 1.
    pub(crate) busy_share: f64,
}

/// A step of the run. The steps follow each other and add up to the run's time.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct PhaseReport {
    pub phase: Phase,
    pub secs: f64,
    /// The most memory of the process until its end, bytes; absent where the system does not tell.
    pub peak_bytes: Option<u64>,
}

#[derive(Clone, Debug, Serialize)]
pub struct EncodeSummary {
    pub generation: u64,
    pub n_gaussians: u64,
    pub n_without_evidence: u64,
    pub n_rejected: u64,
    pub n_views: usize,
    pub n_views_with_photo: usize,
    /// Views whose image is a drawing of the splat, no photo.
    pub n_views_drawn: usize,
    /// Of lengths: `m` or `world units`.
    pub unit: &'static str,
    pub view_order: ViewOrder,
    /// What the used views show of what all views show, where the order is by coverage.
    pub coverage: Option<CoverageReport>,
    /// Seconds spent on rasterising all views to find that order.
    pub coverage_secs: f64,
    pub n_views_resumed: usize,
    /// Kept views that were done anew, and why; absent where none were kept, or those could be taken over.
    pub lost_views: Option<LostViews>,
    /// The encoder of the generation before, if it was another: robots need the text model of this one.
    pub(crate) encoder_before: Option<String>,
    /// Of a few views that were drawn: those that look less like their photo than a plain colour does, and all.
    pub(crate) n_unlike: [usize; 2],
    /// Views without any mask: no mask file, or no mask that is large enough.
    pub n_views_without_masks: usize,
    pub skipped_views: Vec<SkippedView>,
    pub n_masks: usize,
    pub n_regions: usize,
    /// Contributions: pairs of a Gaussian and a region.
    pub n_entries: u64,
    pub n_cells: usize,
    pub n_centroids: u64,
    pub objects: Option<ObjectsReport>,
    /// Free and occupied places, if they were asked for.
    pub occupancy: Option<OccupancyReport>,
    pub shard_bytes: BTreeMap<String, u64>,
    pub cells: Vec<CellReport>,
    pub views: ViewsReport,
    /// Seconds spent in each stage, added over threads.
    pub(crate) busy_secs: BTreeMap<String, f64>,
    /// The load of the views' stages, in their order.
    pub view_stages: Vec<StageReport>,
    pub(crate) phases: Vec<PhaseReport>,
    /// Seconds from the first view to the last.
    pub views_secs: f64,
    pub wall_secs: f64,
    /// The device that ran the image model; absent where no view was left to do, or the model needs no runtime.
    pub(crate) images_on: Option<String>,
    pub encoder: String,
}

/// Whether views that were drawn and compared do not look like their photos: three quarters of them.
pub(super) fn are_unlike([n_unlike, n_compared]: [usize; 2]) -> bool {
    4 * n_unlike >= 3 * n_compared.max(1)
}

impl EncodeSummary {
    /// Whether most of the compared views look like their photos.
    pub(crate) fn fits(&self) -> bool {
        !are_unlike(self.n_unlike)
    }

    /// Whether every view was used, and most of the splat.
    pub(crate) fn is_whole(&self) -> bool {
        self.skipped_views.is_empty() && self.n_rejected <= self.n_gaussians
    }
}
