//! The interface of what does the views of an encode: this machine, or a fleet of workers.

use std::collections::BTreeMap;

use super::context::{Engines, RunContext};
use super::error::EncodeError;
use super::plan::Plan;
use super::report::{SkippedView, StageReport};
use super::sink::ViewRecord;

/// Does the views of an encode; the result does not depend on the executor.
pub(crate) trait Executor {
    /// Names the rasteriser, as far as contributions depend on it.
    fn rasterizer(&self, engines: &Engines<'_>) -> String;

    /// Does the remaining views in the plan's order, and leaves their contributions in the plan's job.
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
    fn begin_publication(&self) -> Result<(), EncodeError> {
        Ok(())
    }
}

pub(crate) struct ViewsRun {
    pub(crate) stages: Vec<StageReport>,
    pub(crate) skipped: Vec<SkippedView>,
    /// Device of the image model, if it ran.
    pub(crate) images_on: Option<String>,
}
