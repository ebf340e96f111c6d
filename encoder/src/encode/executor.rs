//! The interface of what does the views and cells of an encode: this machine, or a fleet of workers.

use std::collections::BTreeMap;

use slag_common::photo_poses::BuiltPhotoPoses;
use slag_common::{Hash32, View};

use super::cell::{FinishedCell, Merged};
use super::context::RunContext;
use super::error::EncodeError;
use super::plan::Plan;
use super::report::{SkippedView, StageReport};
use super::sink::ViewRecord;
use crate::lift::ContributionIndex;

/// Does the views and cells of an encode. The result is the same whoever does them.
pub(crate) trait Executor {
    /// Does the views of the plan's order that are not done, and leaves their contributions in the plan's job.
    ///
    /// # Errors
    /// [`EncodeError`]; finished views stay finished.
    fn run_views(
        &self,
        plan: &Plan<'_>,
        done: &BTreeMap<String, ViewRecord>,
        context: &RunContext<'_>,
    ) -> Result<ViewsRun, EncodeError>;

    /// Builds all cells and leaves their objects in the plan's store; `None` if cancelled.
    ///
    /// # Errors
    /// [`EncodeError`].
    fn build_cells(
        &self,
        cells: &CellsToBuild<'_>,
        context: &RunContext<'_>,
    ) -> Result<Option<Vec<FinishedCell>>, EncodeError>;

    /// Called once, before the manifest is published.
    ///
    /// # Errors
    /// [`EncodeError`] if another encode has taken this one's place.
    fn begin_publication(&self) -> Result<(), EncodeError> {
        Ok(())
    }
}

/// The views of a run.
pub(crate) struct ViewsRun {
    pub(crate) stages: Vec<StageReport>,
    /// Views left out for an error.
    pub(crate) skipped: Vec<SkippedView>,
    /// The device that ran the image model, if it ran.
    pub(crate) images_on: Option<String>,
}

/// The cells to build, and what all views together say about them.
#[derive(Clone, Copy)]
pub(crate) struct CellsToBuild<'a> {
    pub(crate) plan: &'a Plan<'a>,
    /// The views used, in the order of the index.
    #[cfg_attr(not(feature = "fleet"), expect(dead_code, reason = "for a fleet"))]
    pub(crate) views: &'a [&'a View],
    pub(crate) index: &'a ContributionIndex,
    pub(crate) merged: Merged<'a>,
    pub(crate) encoder_id: Hash32,
    /// Where the photos of each cell were taken, if its shards say so; a fleet is not asked for it.
    pub(crate) photo_poses: Option<&'a [BuiltPhotoPoses]>,
    /// Bytes for the contributions of a group of cells.
    pub(crate) group_bytes: u64,
    /// Cells whose embeddings are held at once.
    pub(crate) n_at_once: usize,
}
