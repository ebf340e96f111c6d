//! The second step: every view becomes a file of contributions.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use slag_common::View;

use super::context::{Phase, RunContext};
use super::coverage::CoverageReport;
use super::error::EncodeError;
use super::inputs::Inputs;
use super::job::ViewRecord;
use super::pipeline;
use super::plan::Plan;
use super::report::{SkippedView, StageReport};
use super::view::{ViewStages, Work};
use crate::occupancy::{self, SceneOccupancy};

/// The views of a run, done or left out.
pub(super) struct DoneViews<'a> {
    /// The views whose contributions are used, in the order of their names.
    pub(super) used: Vec<&'a View>,
    /// The records of all views that are done, by name.
    pub(super) records: BTreeMap<String, ViewRecord>,
    /// Views left out for a missing photo or an error, in the order of their names.
    pub(super) skipped: Vec<SkippedView>,
    /// Views left out for an error in this run.
    pub(super) n_failed: usize,
    /// Used views that an earlier run had finished.
    pub(super) n_resumed: usize,
    pub(super) coverage: Option<CoverageReport>,
    pub(super) stages: Vec<StageReport>,
    pub(super) secs: f64,
    /// The device that ran the image model, if it ran.
    pub(super) images_on: Option<String>,
}

/// Takes the views that are not done yet through their stages.
///
/// # Errors
/// [`EncodeError`]; finished views stay finished.
pub(super) fn run_views<'a>(plan: &Plan<'a>, context: &RunContext<'_>) -> Result<DoneViews<'a>, EncodeError> {
    let views = &plan.inputs.views;
    let done = plan.job.done_views()?;
    let n_resumed = plan.order.iter().filter(|view| done.contains_key(&views[**view].name)).count();
    let stages = ViewStages::new(plan, context);
    let start = Instant::now();
    context.progress().begin("views", "view", plan.order.len() as u64, n_resumed as u64);
    let (reports, failed) = run_open_views(plan, &stages, &done, context)?;
    context.progress().end();
    let secs = start.elapsed().as_secs_f64();
    let n_failed = failed.len();
    let mut skipped = [&plan.inputs.missing[..], &failed[..]].concat();
    skipped.sort_by(|a, b| a.view.cmp(&b.view));
    // In the order of names, whatever the order of the work.
    let records = plan.job.done_views()?;
    let is_done = |view: &usize| records.contains_key(&views[*view].name);
    let mut used: Vec<usize> = plan.order.iter().copied().filter(is_done).collect();
    used.sort_unstable();
    if let (true, Some(first)) = (used.is_empty(), skipped.first()) {
        return Err(EncodeError::NoViews { n_views: skipped.len(), reason: first.reason.clone() });
    }
    let coverage = plan.coverage.as_ref().map(|coverage| coverage.report(used.iter().copied()));
    let used = used.into_iter().map(|view| &views[view]).collect();
    let images_on = stages.images_on();
    Ok(DoneViews { used, records, skipped, n_failed, n_resumed, coverage, stages: reports, secs, images_on })
}

/// Returns the views whose contributions are kept, without taking any further.
///
/// # Errors
/// [`EncodeError`].
pub(super) fn kept_views<'a>(plan: &Plan<'a>) -> Result<DoneViews<'a>, EncodeError> {
    let views = &plan.inputs.views;
    let records = plan.job.done_views()?;
    let mut used: Vec<usize> = plan.order.clone();
    used.retain(|view| records.contains_key(&views[*view].name));
    used.sort_unstable();
    if used.is_empty() {
        return Err(EncodeError::NotKept { path: plan.settings.output.store.clone() });
    }
    Ok(DoneViews {
        n_resumed: used.len(),
        used: used.into_iter().map(|view| &views[view]).collect(),
        records,
        skipped: Vec::new(),
        n_failed: 0,
        coverage: None,
        stages: Vec::new(),
        secs: 0.0,
        images_on: None,
    })
}

/// Finds the free and occupied places that the used views show; `None` if the settings do not ask for them.
///
/// # Errors
/// [`EncodeError::Raster`], [`EncodeError::Interrupted`].
pub(super) fn look_around(
    plan: &Plan<'_>,
    views: &DoneViews<'_>,
    context: &RunContext<'_>,
) -> Result<Option<SceneOccupancy>, EncodeError> {
    let Some(settings) = plan.settings.cells.occupancy else { return Ok(None) };
    context.begin_phase(Phase::Occupancy);
    let Inputs { scene, split, .. } = plan.inputs;
    let find = || occupancy::find(scene, split, plan.scene.as_ref(), &views.used, settings, context.cancel());
    let found = context.time("occupancy", || context.install(find));
    let found = found
        .map_err(|(at, source)| EncodeError::Raster { view: views.used[at].name.clone(), source })?
        .ok_or(EncodeError::Interrupted { n_done: views.used.len(), n_views: views.used.len() })?;
    Ok(Some(found))
}

/// Works off the views without a record. Returns the load of the stages, and the views that were left out.
fn run_open_views(
    plan: &Plan<'_>,
    stages: &ViewStages<'_>,
    done: &BTreeMap<String, ViewRecord>,
    context: &RunContext<'_>,
) -> Result<(Vec<StageReport>, Vec<SkippedView>), EncodeError> {
    let run = &plan.settings.run;
    let views = || plan.order.iter().map(|view| &plan.inputs.views[*view]);
    let open = views().filter(|view| !done.contains_key(&view.name));
    let deadline = run.time_budget.and_then(|budget| context.start().checked_add(budget));
    let is_over = || deadline.is_some_and(|deadline| Instant::now() >= deadline);
    let mut budget = Budget { has_some: views().any(|view| done.contains_key(&view.name)) };
    // After ctrl-c no view is begun; those in work are finished.
    let n_alone = context.workers().n_alone(open.clone().count(), run.threads);
    let source = open
        .take_while(|_| !context.is_cancelled() && budget.may_begin(is_over()))
        .enumerate()
        .map(|(i, view)| (i < n_alone, Work::begin(view)));
    let skipped = Mutex::new(Vec::new());
    let list = stages.stages();
    let start = Instant::now();
    let mut reports = pipeline::run(&list, run.threads, source, |at, (is_alone, work)| {
        let view = work.view();
        // The run's threads do the processor's work. Those that wait for a device or the disk must not hold one.
        let result = match list[at].on_cpu {
            true => context.workers().run(is_alone, || stages.step(work)),
            false => stages.step(work),
        };
        match result {
            // One bad photo or mask file of a thousand must not end an encode. A model that fails on one view fails
            // on the others too.
            Err(error) if !run.strict && error.is_of_one_view() => {
                tracing::warn!("view {} is left out: {error}", view.name);
                let skip = SkippedView { view: view.name.clone(), reason: error.to_string() };
                skipped.lock().unwrap_or_else(PoisonError::into_inner).push(skip);
                Ok(None)
            }
            result => result.map(|work| Some((is_alone, work?))),
        }
    })?;
    let wall_secs = start.elapsed().as_secs_f64();
    for report in &mut reports {
        report.add_gpus(stages.loads(&report.stage), wall_secs);
    }
    if context.is_cancelled() {
        let n_done = plan.job.done_views()?.len();
        return Err(EncodeError::Interrupted { n_done, n_views: plan.order.len() });
    }
    Ok((reports, skipped.into_inner().unwrap_or_else(PoisonError::into_inner)))
}

/// Lets views begin until the time is over, but always a first one.
struct Budget {
    /// Whether a view is done or begun.
    has_some: bool,
}

impl Budget {
    /// Returns whether another view may begin, and counts it as begun.
    fn may_begin(&mut self, is_over: bool) -> bool {
        let is_first = !std::mem::replace(&mut self.has_some, true);
        !is_over || is_first
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_view_begins_after_the_time_but_a_first_one() {
        let mut fresh = Budget { has_some: false };
        assert!(fresh.may_begin(false) && fresh.may_begin(false));
        assert!(!fresh.may_begin(true));
        let mut late = Budget { has_some: false };
        assert!(late.may_begin(true) && !late.may_begin(true));
        let mut resumed = Budget { has_some: true };
        assert!(!resumed.may_begin(true) && resumed.may_begin(false));
    }
}
