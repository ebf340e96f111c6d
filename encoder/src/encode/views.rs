//! The second step: every view becomes a file of contributions.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::time::Instant;

use slag_common::View;
use slag_common::landmarks::BuiltLandmarks;

use super::coverage::CoverageReport;
use super::error::EncodeError;
use super::executor::{Executor, ViewsRun};
use super::inputs::Inputs;
use super::plan::Plan;
use super::report::{SkippedView, StageReport};
use super::view::{ViewRecord, ViewSink};
use crate::landmarks;
use crate::memory::Phase;
use crate::occupancy::{self, OccupancyError, SceneOccupancy};
use crate::shard;

pub(super) struct DoneViews<'a> {
    /// Views whose contributions are used, by name.
    pub(super) used: Vec<&'a View>,
    /// Records of all finished views, by name.
    pub(super) records: BTreeMap<String, ViewRecord>,
    /// Left out for a missing photo or an error, by name.
    pub(super) skipped: Vec<SkippedView>,
    /// Left out for an error in this run.
    pub(super) n_failed: usize,
    pub(super) n_resumed: usize,
    pub(super) coverage: Option<CoverageReport>,
    pub(super) stages: Vec<StageReport>,
    pub(super) secs: f64,
    /// Device of the image model, if it ran.
    pub(super) images_on: Option<String>,
}

/// Takes the unfinished views through their stages.
///
/// # Errors
/// [`EncodeError`]; finished views stay finished.
pub(super) fn run_views<'a>(plan: &Plan<'a>, executor: &dyn Executor) -> Result<DoneViews<'a>, EncodeError> {
    let views = &plan.inputs.views;
    let done = plan.job.done_views()?;
    let n_resumed = plan.order.iter().filter(|view| done.contains_key(&views[**view].name)).count();
    let planned: Vec<&View> = plan.order.iter().map(|view| &views[*view]).collect();
    let cells: Vec<_> = plan.inputs.split.cells.iter().map(|cell| cell.mean_bounds).collect();
    plan.context.progress.plan(&planned, &cells);
    let start = Instant::now();
    plan.context.progress.begin("views", "view", plan.order.len() as u64, n_resumed as u64);
    let ViewsRun { stages, skipped: failed, images_on } = executor.run_views(plan, &done)?;
    plan.context.progress.end();
    let secs = start.elapsed().as_secs_f64();
    let n_failed = failed.len();
    let mut skipped = [&plan.inputs.missing[..], &failed[..]].concat();
    skipped.sort_by(|a, b| a.view.cmp(&b.view));
    // Ordered by name, not by completion.
    let records = plan.job.done_views()?;
    let is_done = |view: &usize| records.contains_key(&views[*view].name);
    let mut used: Vec<usize> = plan.order.iter().copied().filter(is_done).collect();
    used.sort_unstable();
    if let (true, Some(first)) = (used.is_empty(), skipped.first()) {
        return Err(EncodeError::NoViews { n_views: skipped.len(), reason: first.reason.clone() });
    }
    let coverage = plan.coverage.as_ref().map(|coverage| coverage.report(used.iter().copied()));
    let used = used.into_iter().map(|view| &views[view]).collect();
    Ok(DoneViews { used, records, skipped, n_failed, n_resumed, coverage, stages, secs, images_on })
}

/// Finds free and occupied places from the used views; `None` if the settings do not ask for them.
pub(super) fn look_around(
    plan: &Plan<'_>,
    views: &DoneViews<'_>,
) -> Result<Option<SceneOccupancy>, EncodeError> {
    let Some(settings) = plan.settings.cells.occupancy else { return Ok(None) };
    plan.context.begin_phase(Phase::Occupancy);
    let Inputs { scene, split, .. } = plan.inputs;
    let drawn = plan.scene.as_ref();
    let memory = plan.memory.clone();
    let find = || occupancy::find(scene, split, drawn, &views.used, settings, memory, plan.context.cancel);
    let found = plan.context.time("occupancy", || plan.context.install(find));
    let found = found
        .map_err(|error| match error {
            OccupancyError::Memory(error) => error.into(),
            OccupancyError::View(at, source) => {
                EncodeError::Raster { view: views.used[at].name.clone(), source }
            }
        })?
        .ok_or(EncodeError::Interrupted { n_done: views.used.len(), n_views: views.used.len() })?;
    Ok(Some(found))
}

/// Finds each cell's landmarks in the used photos; `None` if the settings do not ask for them.
pub(super) fn find_landmarks(
    plan: &Plan<'_>,
    views: &DoneViews<'_>,
) -> Result<Option<Vec<BuiltLandmarks>>, EncodeError> {
    if !plan.settings.cells.landmarks {
        return Ok(None);
    }
    plan.context.begin_phase(Phase::Landmarks);
    let n_views = views.used.len();
    plan.context.progress.begin("landmarks", "view", n_views as u64, 0);
    let mut mapping = Vec::with_capacity(n_views);
    for (number, view) in views.used.iter().enumerate() {
        if plan.context.cancel.load(Ordering::Relaxed) {
            return Err(EncodeError::Interrupted { n_done: n_views, n_views });
        }
        let observe = || landmarks::observe(plan.scene.as_ref(), number as u16, view);
        let observed = plan.context.time("landmarks", || plan.context.install(observe));
        let failed = |source| EncodeError::Landmarks { view: view.name.clone(), source };
        mapping.push(observed.map_err(failed)?);
        plan.job.check_unchanged(view, plan.segmenter.as_ref())?;
        plan.context.progress.advance(1);
    }
    plan.context.progress.end();
    let Inputs { scene, split, .. } = plan.inputs;
    let found = plan.context.time("landmarks", || landmarks::landmarks(&mapping, scene.len()));
    Ok(Some(shard::landmarks(split, slag_locate::CODE_VERSION, &found)))
}
