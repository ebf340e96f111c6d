//! Does the views of an encode on this machine.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use slag_common::View;

use super::context::Engines;
use super::error::EncodeError;
use super::pipeline;
use super::plan::Plan;
use super::report::{LeftOut, SkippedView, StageReport};
use super::view::{ViewRecord, ViewStages, Work};

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
            report.add_gpus(stages.loads(&report.stage), wall_secs);
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
    pub(crate) skipped: Vec<SkippedView>,
    /// Device of the image model, if it ran.
    pub(crate) images_on: Option<String>,
}
