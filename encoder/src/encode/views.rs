//! The second step: every view becomes a file of contributions.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use slag_common::View;
use slag_common::landmarks::BuiltLandmarks;

use super::context::Engines;
use super::coverage::CoverageReport;
use super::error::EncodeError;
use super::inputs::Inputs;
use super::pipeline;
use super::plan::Plan;
use super::report::{GpuReport, LeftOut, SkippedView, StageReport};
use super::view::{ViewRecord, ViewSink, ViewStages, Work};
use crate::lanes::GpuLoad;
use crate::lift::ContributionIndex;
use crate::memory::Phase;
use crate::occupancy::{self, OccupancyError, SceneOccupancy};
use crate::{landmarks, shard};

pub(super) struct DoneViews<'a> {
    /// Views whose contributions are used, by name.
    pub(super) used: Vec<&'a View>,
    /// Records of all finished views, by name.
    pub(super) records: BTreeMap<String, ViewRecord>,
    /// Left out for a missing photo or an error, by name.
    pub(super) skipped: Vec<SkippedView>,
    pub(super) n_resumed: usize,
    pub(super) coverage: Option<CoverageReport>,
    pub(super) run: ViewsRun,
    pub(super) secs: f64,
}

impl DoneViews<'_> {
    /// Leaves out views that have masks but see no Gaussian, unless all are such; returns whether there are any.
    pub(super) fn leave_out_blind(&mut self, index: &ContributionIndex) -> bool {
        let is_blind: Vec<bool> =
            index.views.iter().map(|view| view.n_masks > 0 && view.file.n_entries == 0).collect();
        if !is_blind.contains(&true) || !is_blind.contains(&false) {
            return false;
        }
        let mut left_out = LeftOut::default();
        let blind = |(view, is_blind): (&&View, &bool)| is_blind.then(|| view.name.clone());
        for name in self.used.iter().zip(&is_blind).filter_map(blind) {
            let reason = "it sees no Gaussian of the splat; correct its pose, or leave it out with --drop";
            left_out.push(name, reason.into());
        }
        self.skipped.extend(left_out.end());
        let mut is_blind = is_blind.into_iter();
        self.used.retain(|_| !is_blind.next().unwrap_or_default());
        true
    }
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
    let run = executor.run_views(plan, &done)?;
    plan.context.progress.end();
    let secs = start.elapsed().as_secs_f64();
    let mut skipped = [&plan.inputs.missing[..], &run.skipped[..]].concat();
    skipped.sort_by(|a, b| a.view.cmp(&b.view));
    // Ordered by name, not by completion.
    let records = plan.job.done_views()?;
    let is_done = |view: &usize| records.contains_key(&views[*view].name);
    let mut used: Vec<usize> = plan.order.iter().copied().filter(is_done).collect();
    used.sort_unstable();
    if let (true, Some(first)) = (used.is_empty(), skipped.first()) {
        return Err(EncodeError::no_views(skipped.len(), &first.reason));
    }
    let coverage = plan.coverage.as_ref().map(|coverage| coverage.report(used.iter().copied()));
    let used = used.into_iter().map(|view| &views[view]).collect();
    Ok(DoneViews { used, records, skipped, n_resumed, coverage, run, secs })
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

pub(super) struct Here;

impl Executor for Here {
    fn rasterizer(&self, engines: &Engines<'_>) -> String {
        engines.rasterizer.identity()
    }

    fn run_views(
        &self,
        plan: &Plan<'_>,
        done: &BTreeMap<String, ViewRecord>,
    ) -> Result<ViewsRun, EncodeError> {
        let run = &plan.settings.run;
        let stages = ViewStages::new(plan.view_tools());
        let views = || plan.order.iter().map(|view| &plan.inputs.views[*view]);
        let open = views().filter(|view| !done.contains_key(&view.name));
        let deadline = run.time_budget.and_then(|budget| plan.context.start.checked_add(budget));
        let is_over = || deadline.is_some_and(|deadline| Instant::now() >= deadline);
        let mut has_some = views().any(|view| done.contains_key(&view.name));
        // At least one view is used, however late it is.
        let mut may_begin = || !std::mem::replace(&mut has_some, true) || !is_over();
        // After ctrl-c no view begins; those under way are finished.
        let n_alone = plan.context.workers.n_alone(open.clone().count(), run.threads);
        let source = open
            .take_while(|_| !plan.context.is_cancelled() && may_begin())
            .enumerate()
            .map(|(i, view)| (i < n_alone, view));
        let skipped = Mutex::new(LeftOut::default());
        let start = Instant::now();
        let mut reports = work_off(&stages, source, |view, error| {
            if run.strict {
                return Err(error);
            }
            let reason = error.to_string();
            plan.context.progress.left_out(&view.name, &reason);
            skipped.lock().unwrap_or_else(PoisonError::into_inner).push(view.name.clone(), reason);
            Ok(())
        })?;
        let wall_secs = start.elapsed().as_secs_f64();
        for report in &mut reports {
            let gpu = |load: GpuLoad| GpuReport { busy_share: load.busy_secs / wall_secs, load };
            report.gpus = stages.loads(&report.stage).into_iter().map(gpu).collect();
        }
        if plan.context.is_cancelled() {
            let n_done = plan.job.done_views()?.len();
            return Err(EncodeError::Interrupted { n_done, n_views: plan.order.len() });
        }
        let skipped = skipped.into_inner().unwrap_or_else(PoisonError::into_inner).end();
        Ok(ViewsRun { stages: reports, skipped, images_on: stages.images_on() })
    }
}

/// Takes views through their stages, each on a thread of its own or on all. `on_bad_view` gets errors of one view's
/// input; the view then ends.
///
/// # Errors
/// Those of the stages that lie in no view, and those of `on_bad_view`.
pub(crate) fn work_off<'v>(
    stages: &ViewStages<'_>,
    source: impl Iterator<Item = (bool, &'v View)> + Send,
    on_bad_view: impl Fn(&View, EncodeError) -> Result<(), EncodeError> + Sync,
) -> Result<Vec<StageReport>, EncodeError> {
    let tools = &stages.tools;
    let (list, is_here) = (tools.stages(), tools.photos.is_none());
    let source = source.map(|(is_alone, view)| (is_alone, Work::begin(view, is_here)));
    let done = pipeline::run(&list, tools.n_threads, source, |at, (is_alone, work)| {
        let view = work.view;
        // Stages that wait for a device or the disk must not hold a thread of the run.
        let result = match list[at].on_cpu {
            true => tools.context.workers.run(is_alone, || stages.step(work)),
            false => stages.step(work),
        };
        match result {
            // One bad file of a thousand must not end an encode; a model that fails on one view fails on all.
            Err(error) if error.is_of_one_view() => on_bad_view(view, error).map(|()| None),
            result => result.map(|work| Some((is_alone, work?))),
        }
    });
    stages.warn();
    done
}

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
    ) -> Result<ViewsRun, EncodeError>;

    /// Called once, before the manifest is published.
    fn begin_publication(&self) -> Result<(), EncodeError> {
        Ok(())
    }
}

pub(crate) struct ViewsRun {
    pub(crate) stages: Vec<StageReport>,
    /// Left out for an error in this run.
    pub(crate) skipped: Vec<SkippedView>,
    /// Device of the image model, if it ran.
    pub(crate) images_on: Option<String>,
}
