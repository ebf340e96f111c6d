//! The coordinator: uploads the inputs of an encode, and brings the views that workers do to this machine, which
//! makes the cells.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use slag_common::{Hash32, durable};

use super::documents::{self, FailedView};
use super::heartbeat::Heartbeat;
use super::queue::{Enqueuer, QueueSettings};
use super::run::Run;
use super::worker::pause;
use super::{damaged, objects, prepared};
use crate::blobs::Bucket;
use crate::encode::fleet_parts::{Executor, LeftOut, OF_A_FLEET, Plan, ViewRecord, ViewsRun};
use crate::encode::{EncodeError, Engines, SkippedView};

pub(crate) struct Coordinator {
    bucket: Arc<Bucket>,
    /// Hands out work; without it, workers have shares.
    queue: Option<QueueSettings>,
    /// From the run's beginning to its publication.
    run: Mutex<Option<(Run, Heartbeat)>>,
}

impl Coordinator {
    pub(crate) fn new(bucket: Arc<Bucket>, queue: Option<QueueSettings>) -> Self {
        Self { bucket, queue, run: Mutex::default() }
    }

    fn begin(
        &self,
        plan: &Plan<'_>,
        done: &BTreeMap<String, ViewRecord>,
    ) -> Result<ViewsInWork<'_>, EncodeError> {
        let is_open = |view: &usize| !done.contains_key(&plan.inputs.views[*view].name);
        let open: Vec<usize> = plan.order.iter().copied().filter(is_open).collect();
        let run_plan = prepared::upload(&self.bucket, plan, &open)?;
        let run = Run::begin(&self.bucket, &run_plan)?;
        let open_queue = |queue| Enqueuer::open(&self.bucket.runtime, queue, run, run_plan.of_scene);
        let queue = self.queue.as_ref().map(open_queue).transpose()?;
        let heartbeat = Heartbeat::start(&self.bucket, run);
        *self.run.lock().unwrap_or_else(PoisonError::into_inner) = Some((run, heartbeat));
        let (n_open, url) = (open.len(), &self.bucket.url);
        tracing::info!(
            "run {}: {n_open} views to do; workers join with `slag-encoder worker --blobs {url}`",
            run.0
        );
        let views = run_plan.views.into_iter().enumerate();
        let open = views.map(|(number, view)| (view.id, (number, view.name))).collect();
        Ok(ViewsInWork { bucket: &self.bucket, run, queue, open, skipped: LeftOut::default() })
    }
}

impl Executor for Coordinator {
    fn rasterizer(&self, _: &Engines<'_>) -> String {
        OF_A_FLEET.into()
    }

    fn run_views(
        &self,
        plan: &Plan<'_>,
        done: &BTreeMap<String, ViewRecord>,
    ) -> Result<ViewsRun, EncodeError> {
        let mut views = self.begin(plan, done)?;
        while !views.open.is_empty() {
            let n_fetched = views.fetch_done(plan)?;
            views.take_failed(plan.settings.run.strict)?;
            if plan.context.is_cancelled() {
                let n_done = plan.job.done_views()?.len();
                return Err(EncodeError::Interrupted { n_done, n_views: plan.order.len() });
            }
            if n_fetched == 0 && !views.open.is_empty() {
                views.wait()?;
            }
        }
        Ok(ViewsRun { stages: Vec::new(), skipped: views.end()?, images_on: None })
    }

    fn begin_publication(&self) -> Result<(), EncodeError> {
        match &*self.run.lock().unwrap_or_else(PoisonError::into_inner) {
            Some((run, _)) => run.publish(&self.bucket),
            None => Ok(()),
        }
    }
}

/// Views of a run that are not on this machine yet.
struct ViewsInWork<'a> {
    bucket: &'a Bucket,
    run: Run,
    queue: Option<Enqueuer>,
    /// By identity: index in the plan, and name.
    open: BTreeMap<Hash32, (usize, String)>,
    skipped: LeftOut,
}

impl ViewsInWork<'_> {
    /// Downloads finished views into this machine's job; returns their number.
    fn fetch_done(&mut self, plan: &Plan<'_>) -> Result<usize, EncodeError> {
        let names = self.bucket.list("views")?;
        let there: BTreeSet<Hash32> = names.iter().filter_map(|name| name.parse().ok()).collect();
        let fresh: Vec<(&Hash32, &(usize, String))> =
            self.open.iter().filter(|(id, _)| there.contains(id)).collect();
        let fetch = |(id, (_, name)): &(&Hash32, &(usize, String))| {
            self.fetch_view(plan, **id, name)?;
            plan.context.progress.advance(1);
            Ok::<_, EncodeError>(())
        };
        plan.context.install(|| fresh.par_iter().try_for_each(fetch))?;
        let n_fresh = fresh.len();
        self.open.retain(|id, _| !there.contains(id));
        Ok(n_fresh)
    }

    fn fetch_view(&self, plan: &Plan<'_>, id: Hash32, name: &str) -> Result<(), EncodeError> {
        let key = documents::view_key(id);
        let bytes = self.bucket.require(&key)?;
        let (record, outlines, contributions) =
            objects::unpack_view(&bytes).map_err(|e| damaged(self.bucket, &key, e))?;
        durable::write(&plan.job.outlines_path(name), &outlines)?;
        durable::write(&plan.job.contributions_path(name), &contributions)?;
        plan.job.mark_done(name, record)
    }

    /// Leaves out views that workers could not do; with `is_strict`, fails at the first.
    fn take_failed(&mut self, is_strict: bool) -> Result<(), EncodeError> {
        for name in self.bucket.list(&self.run.failed_folder())? {
            let number: Option<usize> = name.strip_suffix(".json").and_then(|number| number.parse().ok());
            let Some(id) = self.open.iter().find(|(_, (n, _))| Some(*n) == number).map(|(id, _)| *id) else {
                continue;
            };
            let key = format!("{}/{name}", self.run.failed_folder());
            let FailedView { reason } = documents::parse(self.bucket, &key, &self.bucket.require(&key)?)?;
            let Some((_, view)) = self.open.remove(&id) else { continue };
            if is_strict {
                return Err(EncodeError::Failed(format!("view {view}: {reason}")));
            }
            self.skipped.push(view, reason);
        }
        Ok(())
    }

    fn wait(&mut self) -> Result<(), EncodeError> {
        self.run.check(self.bucket)?;
        let mut numbers: Vec<usize> = self.open.values().map(|(number, _)| *number).collect();
        numbers.sort_unstable();
        if let Some(queue) = &mut self.queue {
            queue.keep_filled(&numbers);
        }
        std::thread::sleep(pause(self.bucket));
        Ok(())
    }

    /// Dismisses the workers; returns the left-out views.
    fn end(self) -> Result<Vec<SkippedView>, EncodeError> {
        self.run.views_are_done(self.bucket)?;
        if let Some(queue) = &self.queue {
            queue.close();
        }
        Ok(self.skipped.end())
    }
}
