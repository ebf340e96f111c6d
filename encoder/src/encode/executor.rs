//! The interface of what does the views of an encode: this machine, or a fleet of workers.

use std::collections::BTreeMap;

use slag_common::Hash32;
use slag_common::photo_poses::BuiltPhotoPoses;

use super::cell::Merged;
use super::context::RunContext;
use super::error::EncodeError;
use super::plan::Plan;
use super::report::{SkippedView, StageReport};
use super::sink::ViewRecord;
use crate::lift::ContributionIndex;

/// Does the views of an encode. The result is the same whoever does them.
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
    pub(crate) index: &'a ContributionIndex,
    pub(crate) merged: Merged<'a>,
    pub(crate) encoder_id: Hash32,
    /// Where the photos of each cell were taken, if its shards say so.
    pub(crate) photo_poses: Option<&'a [BuiltPhotoPoses]>,
    /// Bytes for the contributions of a group of cells.
    pub(crate) group_bytes: u64,
    /// Cells whose embeddings are held at once.
    pub(crate) n_at_once: usize,
}
