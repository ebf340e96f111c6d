//! Does the views of an encode on this machine, and the cells.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use slag_common::View;

use super::cell::{CellInWork, CellMaker, FinishedCell};
use super::context::RunContext;
use super::error::EncodeError;
use super::executor::{CellsToBuild, Executor, ViewsRun};
use super::pipeline;
use super::plan::Plan;
use super::report::{LeftOut, StageReport};
use super::sink::ViewRecord;
use super::view::{ViewStages, Work};

/// This machine.
pub(super) struct Here;

impl Executor for Here {
    fn run_views(
        &self,
        plan: &Plan<'_>,
        done: &BTreeMap<String, ViewRecord>,
        context: &RunContext<'_>,
    ) -> Result<ViewsRun, EncodeError> {
        let run = &plan.settings.run;
        let stages = ViewStages::new(plan.view_tools(), context);
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
            .map(|(i, view)| (i < n_alone, view));
        let skipped = Mutex::new(LeftOut::default());
        let start = Instant::now();
        let mut reports = work_off(&stages, run.threads, source, context, |view, error| {
            if run.strict {
                return Err(error);
            }
            let reason = error.to_string();
            context.progress().left_out(&view.name, &reason);
            locked(&skipped).push(view.name.clone(), reason);
            Ok(())
        })?;
        let wall_secs = start.elapsed().as_secs_f64();
        for report in &mut reports {
            report.add_gpus(stages.loads(&report.stage), wall_secs);
        }
        if context.is_cancelled() {
            let n_done = plan.job.done_views()?.len();
            return Err(EncodeError::Interrupted { n_done, n_views: plan.order.len() });
        }
        let skipped = skipped.into_inner().unwrap_or_else(PoisonError::into_inner).end();
        Ok(ViewsRun { stages: reports, skipped, images_on: stages.images_on() })
    }
}

/// Takes views through their stages: each with whether it has a thread of its own. `on_bad_view` is told of an error
/// that lies in one view's input; the view then ends.
///
/// # Errors
/// Those of the stages that lie in no view, and those of `on_bad_view`.
pub(crate) fn work_off<'v>(
    stages: &ViewStages<'_>,
    n_threads: usize,
    source: impl Iterator<Item = (bool, &'v View)> + Send,
    context: &RunContext<'_>,
    on_bad_view: impl Fn(&View, EncodeError) -> Result<(), EncodeError> + Sync,
) -> Result<Vec<StageReport>, EncodeError> {
    let list = stages.stages();
    let source = source.map(|(is_alone, view)| (is_alone, Work::begin(view, stages.has_photos())));
    let done = pipeline::run(&list, n_threads, source, |at, (is_alone, work)| {
        let view = work.view();
        // The run's threads do the processor's work. Those that wait for a device or the disk must not hold one.
        let result = match list[at].on_cpu {
            true => context.workers().run(is_alone, || stages.step(work)),
            false => stages.step(work),
        };
        match result {
            // One bad photo or mask file of a thousand must not end an encode. A model that fails on one view fails
            // on the others too.
            Err(error) if error.is_of_one_view() => on_bad_view(view, error).map(|()| None),
            result => result.map(|work| Some((is_alone, work?))),
        }
    });
    stages.rotated.warn();
    done
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

/// Lifts the cells and makes their shards, several at once; `None` if cancelled.
///
/// # Errors
/// [`EncodeError`]: of the first cell that failed.
pub(super) fn build_cells(
    cells: &CellsToBuild<'_>,
    context: &RunContext<'_>,
) -> Result<Option<Vec<FinishedCell>>, EncodeError> {
    let CellsToBuild { plan, index, merged, group_bytes, n_at_once, .. } = *cells;
    let split = &plan.inputs.split;
    let maker = CellMaker {
        scene: &plan.inputs.scene,
        split,
        settings: &plan.settings.cells.shards,
        encoder_id: cells.encoder_id,
        merged,
        store: plan.store,
        context,
    };
    let dim = merged.table.dim();
    // The vectors of a large cell are allocated once and used again; they are neither copied nor cleared.
    let free = FreeCells::new((0..n_at_once).map(|_| CellInWork::empty(dim)).collect());
    let finished: Mutex<BTreeMap<u32, Result<FinishedCell, EncodeError>>> = Mutex::default();
    let has_failed = AtomicBool::new(false);
    let is_stopped = || context.is_cancelled() || has_failed.load(Ordering::Relaxed);
    let workers = context.workers();
    let n_alone = workers.n_alone(split.cells.len(), n_at_once);
    std::thread::scope(|scope| -> Result<(), EncodeError> {
        let mut parts = context.install(|| index.transposed_parts(merged.table, group_bytes));
        let mut next_part = || context.time("merge", || context.install(|| parts.next()));
        let mut lent = free.take();
        while let Some(contributions) = next_part() {
            if is_stopped() {
                break;
            }
            let contributions = contributions?;
            let cell_id = contributions.part.cell_id;
            let n_gaussians = split.cells[cell_id as usize].gaussians.len();
            if contributions.part.locals.end < n_gaussians {
                // A large cell comes in parts, so that only one of them is held.
                context.install(|| maker.add_part(contributions, &mut lent.cell))?;
                continue;
            }
            if let Some(of_cells) = cells.photo_poses {
                lent.cell.photo_poses = of_cells[cell_id as usize].clone();
            }
            let (finished, has_failed) = (&finished, &has_failed);
            let work = move || {
                if !is_stopped() {
                    let added = maker.add_part(contributions, &mut lent.cell);
                    let result = added.and_then(|()| maker.finish_cell(cell_id, &mut lent.cell));
                    has_failed.fetch_or(result.is_err(), Ordering::Relaxed);
                    locked(finished).insert(cell_id, result);
                    context.progress().advance(1);
                }
                drop(lent);
            };
            scope.spawn(move || workers.run((cell_id as usize) < n_alone, work));
            lent = free.take();
        }
        Ok(())
    })?;
    let finished = finished.into_inner().unwrap_or_else(PoisonError::into_inner);
    let finished: Vec<FinishedCell> = finished.into_values().collect::<Result<_, _>>()?;
    Ok((!context.is_cancelled()).then_some(finished))
}

/// Cells that are not in work.
struct FreeCells {
    cells: Mutex<Vec<CellInWork>>,
    given_back: Condvar,
}

impl FreeCells {
    fn new(cells: Vec<CellInWork>) -> Self {
        Self { cells: Mutex::new(cells), given_back: Condvar::new() }
    }

    /// Waits until one is free.
    fn take(&self) -> LentCell<'_> {
        let mut cells = locked(&self.cells);
        loop {
            match cells.pop() {
                Some(cell) => return LentCell { cell, owner: self },
                None => cells = self.given_back.wait(cells).unwrap_or_else(PoisonError::into_inner),
            }
        }
    }
}

/// A cell that goes back, emptied, whatever becomes of the work.
struct LentCell<'a> {
    cell: CellInWork,
    owner: &'a FreeCells,
}

impl Drop for LentCell<'_> {
    fn drop(&mut self) {
        let mut cell = std::mem::replace(&mut self.cell, CellInWork::empty(0));
        cell.clear();
        locked(&self.owner.cells).push(cell);
        self.owner.given_back.notify_one();
    }
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
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
