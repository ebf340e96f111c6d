//! The coordinator: uploads the inputs of an encode, waits for the workers, brings their views and cells home.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use slag_common::{Hash32, durable};

use super::dispatch::Item;
use super::documents::{self, CellsPlan, FailedView, MergedView};
use super::error::FleetError;
use super::pulse::Heart;
use super::queue::{Enqueuer, QueueSettings};
use super::run::Run;
use super::worker::pause;
use super::{inputs, merged, view_object};
use crate::blobs::Bucket;
use crate::encode::fleet_parts::{
    CellsToBuild, Executor, FinishedCell, Plan, RunContext, ViewRecord, ViewsRun,
};
use crate::encode::{self, EncodeError, EncodeSettings, EncodeSummary, Engines, SkippedView};
use crate::progress::Progress;

/// The executor of an encode whose views and cells are done by workers.
pub struct Coordinator {
    bucket: Arc<Bucket>,
    queue: Option<QueueSettings>,
    /// The run, once it has begun.
    run: Mutex<Option<OpenRun>>,
}

/// A run that has begun.
struct OpenRun {
    run: Run,
    queue: Option<Enqueuer>,
    _heart: Heart,
}

impl Coordinator {
    /// Makes a coordinator. `queue`: where work is handed out; without it, workers have shares.
    pub fn new(bucket: Arc<Bucket>, queue: Option<QueueSettings>) -> Self {
        Self { bucket, queue, run: Mutex::default() }
    }

    /// Encodes a scene as [`encode::encode`] does, by the fleet.
    ///
    /// # Errors
    /// As of [`encode::encode`].
    pub fn encode(
        &self,
        settings: &EncodeSettings,
        engines: &Engines<'_>,
        progress: &dyn Progress,
        cancel: &AtomicBool,
    ) -> Result<EncodeSummary, EncodeError> {
        encode::encode_by(self, settings, engines, progress, cancel)
    }

    fn begin(
        &self,
        plan: &Plan<'_>,
        done: &BTreeMap<String, ViewRecord>,
        context: &RunContext<'_>,
    ) -> Result<Views, FleetError> {
        self.upload_done(plan, done, context)?;
        let open: Vec<usize> = plan
            .order
            .iter()
            .copied()
            .filter(|view| !done.contains_key(&plan.inputs.views[*view].name))
            .collect();
        let run_plan = inputs::upload(&self.bucket, plan, &open, context)?;
        let run = Run::begin(&self.bucket, &run_plan)?;
        let queue = self
            .queue
            .as_ref()
            .map(|queue| Enqueuer::open(self.bucket.runtime(), queue, run, run_plan.of_scene))
            .transpose()?;
        let open_run = OpenRun { run, queue, _heart: Heart::start(&self.bucket, run) };
        *self.run.lock().unwrap_or_else(PoisonError::into_inner) = Some(open_run);
        let url = self.bucket.url();
        tracing::info!(
            "run {}: {} views to do; workers join with `slag-encoder worker --blobs {url}`",
            run.0,
            open.len()
        );
        let open =
            run_plan.views.into_iter().enumerate().map(|(number, view)| (view.id, (number, view.name)));
        Ok(Views { run, open: open.collect() })
    }

    /// Puts the views that earlier runs did on this machine: cells are made from the bucket's.
    fn upload_done(
        &self,
        plan: &Plan<'_>,
        done: &BTreeMap<String, ViewRecord>,
        context: &RunContext<'_>,
    ) -> Result<(), FleetError> {
        let there: BTreeSet<String> = self.bucket.list("views")?.into_iter().collect();
        let put = |(name, record): (&String, &ViewRecord)| -> Result<(), FleetError> {
            let id = plan.job.id_of(name);
            if !there.contains(&id.to_string()) {
                let outlines = fs_err::read(plan.job.outlines_path(name))?;
                let contributions = fs_err::read(plan.job.contributions_path(name))?;
                let bytes = view_object::pack(*record, &outlines, &contributions)?;
                self.bucket.put_new(&documents::view_key(id), bytes)?;
            }
            Ok(())
        };
        context.install(|| done.par_iter().try_for_each(put))
    }

    /// Brings a view's contributions into the job of this machine.
    fn fetch_view(&self, plan: &Plan<'_>, id: Hash32, name: &str) -> Result<(), FleetError> {
        let key = documents::view_key(id);
        let bytes = self.bucket.require(&key)?;
        let parts = view_object::unpack(&bytes).map_err(|e| FleetError::damaged(&self.bucket, &key, e))?;
        durable::write(&plan.job.outlines_path(name), &bytes[parts.outlines])?;
        durable::write(&plan.job.contributions_path(name), &bytes[parts.contributions])?;
        Ok(plan.job.mark_done(name, parts.record)?)
    }

    /// Calls `work` with the run and its queue.
    fn with_run<T>(
        &self,
        work: impl FnOnce(Run, Option<&mut Enqueuer>) -> Result<T, FleetError>,
    ) -> Result<T, FleetError> {
        let mut run = self.run.lock().unwrap_or_else(PoisonError::into_inner);
        match &mut *run {
            Some(OpenRun { run, queue, .. }) => work(*run, queue.as_mut()),
            None => Err(FleetError::Io(std::io::Error::other("cells before views"))),
        }
    }
}

/// The views of a run that are not done.
struct Views {
    run: Run,
    /// Number in the plan and name, by identity.
    open: BTreeMap<Hash32, (usize, String)>,
}

impl Executor for Coordinator {
    fn run_views(
        &self,
        plan: &Plan<'_>,
        done: &BTreeMap<String, ViewRecord>,
        context: &RunContext<'_>,
    ) -> Result<ViewsRun, EncodeError> {
        let Views { run, mut open } = self.begin(plan, done, context)?;
        let mut skipped = Vec::new();
        while !open.is_empty() {
            let there: BTreeSet<Hash32> =
                self.bucket.list("views")?.iter().filter_map(|name| name.parse().ok()).collect();
            let fresh: Vec<(Hash32, String)> = open
                .iter()
                .filter(|(id, _)| there.contains(id))
                .map(|(id, (_, name))| (*id, name.clone()))
                .collect();
            let fetch = |(id, name): &(Hash32, String)| {
                self.fetch_view(plan, *id, name)?;
                context.progress().advance(1);
                Ok::<_, FleetError>(())
            };
            context.install(|| fresh.par_iter().try_for_each(fetch))?;
            open.retain(|id, _| !there.contains(id));
            for name in self.bucket.list(&run.failed_folder())? {
                let key = format!("{}/{name}", run.failed_folder());
                let number: Option<usize> = name.strip_suffix(".json").and_then(|number| number.parse().ok());
                let Some((id, view)) = open
                    .iter()
                    .find(|(_, (n, _))| Some(*n) == number)
                    .map(|(id, (_, view))| (*id, view.clone()))
                else {
                    continue;
                };
                let FailedView { reason } =
                    documents::parse(&self.bucket, &key, &self.bucket.require(&key)?)?;
                if plan.settings.run.strict {
                    return Err(FleetError::View { view, reason }.into());
                }
                tracing::warn!("view {view} is left out: {reason}");
                open.remove(&id);
                skipped.push(SkippedView { view, reason });
            }
            if context.is_cancelled() {
                return Err(EncodeError::Interrupted {
                    n_done: plan.job.done_views()?.len(),
                    n_views: plan.order.len(),
                });
            }
            if fresh.is_empty() && !open.is_empty() {
                run.check(&self.bucket)?;
                let mut items: Vec<Item> = open.values().map(|(number, _)| Item::View(*number)).collect();
                items.sort_unstable();
                self.with_run(|_, queue| {
                    queue.into_iter().for_each(|queue| queue.keep_filled(&items));
                    Ok(())
                })?;
                std::thread::sleep(pause(&self.bucket));
            }
        }
        Ok(ViewsRun { stages: Vec::new(), skipped, images_on: None })
    }

    fn build_cells(
        &self,
        cells: &CellsToBuild<'_>,
        context: &RunContext<'_>,
    ) -> Result<Option<Vec<FinishedCell>>, EncodeError> {
        let cells_plan = self.begin_cells(cells)?;
        let folder = documents::cells_folder(cells_plan.id);
        let mut finished: BTreeMap<u32, FinishedCell> = BTreeMap::new();
        while finished.len() < cells_plan.order.len() {
            let there: BTreeSet<u32> = self
                .bucket
                .list(&folder)?
                .iter()
                .filter_map(|name| name.strip_suffix(".json")?.parse().ok())
                .collect();
            let fresh: Vec<u32> = there.into_iter().filter(|cell| !finished.contains_key(cell)).collect();
            let fetch = |cell: &u32| {
                let fetched = self.fetch_cell(cells.plan, &cells_plan, *cell)?;
                context.progress().advance(1);
                Ok::<_, FleetError>((*cell, fetched))
            };
            let fetched: Vec<_> =
                context.install(|| fresh.par_iter().map(fetch).collect::<Result<_, _>>())?;
            finished.extend(fetched);
            if context.is_cancelled() {
                return Ok(None);
            }
            if fresh.is_empty() {
                self.wait_for_cells(&cells_plan, &finished)?;
            }
        }
        Ok(Some(finished.into_values().collect()))
    }

    fn begin_publication(&self) -> Result<(), EncodeError> {
        self.with_run(|run, queue| {
            run.publish(&self.bucket)?;
            if let Some(queue) = queue {
                queue.close();
            }
            Ok(())
        })?;
        Ok(())
    }
}

impl Coordinator {
    /// Uploads what all views say about the cells, and lets workers begin with them.
    fn begin_cells(&self, cells: &CellsToBuild<'_>) -> Result<CellsPlan, FleetError> {
        let bytes = merged::pack(cells)?;
        let merged_hash = Hash32::of(&bytes);
        let key = documents::merged_key(merged_hash);
        if self.bucket.len_of(&key)?.is_none() {
            self.bucket.put_new(&key, bytes)?;
        }
        let job = &cells.plan.job;
        let mut views = Vec::with_capacity(cells.views.len());
        for view in cells.views {
            let id = job.id_of(&view.name);
            // They end the object, as the file that this machine has.
            let len_bytes = fs_err::metadata(job.contributions_path(&view.name))?.len();
            let key = documents::view_key(id);
            let object_bytes = self.bucket.len_of(&key)?;
            let at = object_bytes.and_then(|object_bytes| object_bytes.checked_sub(len_bytes));
            let at = at.ok_or_else(|| {
                FleetError::damaged(&self.bucket, &key, "it is missing, or shorter than its contributions")
            })?;
            views.push(MergedView { id, name: view.name.clone(), contributions_at_bytes: at });
        }
        let mut n_entries = vec![0u64; cells.plan.inputs.split.cells.len()];
        cells.index.parts().iter().for_each(|part| n_entries[part.cell_id as usize] += part.n_entries);
        let mut order: Vec<u32> = (0..n_entries.len() as u32).collect();
        let cost = |cell: &u32| {
            (n_entries[*cell as usize], cells.plan.inputs.split.cells[*cell as usize].gaussians.len())
        };
        order.sort_by_key(|cell| std::cmp::Reverse(cost(cell)));
        let settings = cells.plan.settings.cells.shards.clone();
        let ids: Vec<Hash32> = views.iter().map(|view| view.id).collect();
        let identity = documents::to_bytes(&(
            documents::own_version(),
            job.of_scene(),
            merged_hash,
            ids,
            &settings,
            cells.encoder_id,
        ))?;
        let cells_plan = CellsPlan {
            id: Hash32::of(&identity),
            merged: merged_hash,
            encoder_id: cells.encoder_id,
            settings,
            views,
            order,
        };
        self.with_run(|run, _| run.begin_cells(&self.bucket, &cells_plan))?;
        Ok(cells_plan)
    }

    /// Brings a cell's record, and its objects into the store of this machine.
    fn fetch_cell(
        &self,
        plan: &Plan<'_>,
        cells_plan: &CellsPlan,
        cell: u32,
    ) -> Result<FinishedCell, FleetError> {
        let key = documents::cell_key(cells_plan.id, cell);
        let finished: FinishedCell = documents::parse(&self.bucket, &key, &self.bucket.require(&key)?)?;
        if finished.record.cell_id != cell {
            return Err(FleetError::damaged(
                &self.bucket,
                &key,
                format!("it is the record of cell {}", finished.record.cell_id),
            ));
        }
        let shards = finished.record.shards.values().map(|shard| shard.hash);
        for hash in shards.chain(finished.fields.iter().map(|(_, hash)| *hash)) {
            let key = documents::object_key(hash);
            let bytes = self.bucket.require(&key)?;
            let (found, _) = plan.store.put_bytes(&bytes).map_err(EncodeError::from)?;
            if found != hash {
                return Err(FleetError::damaged(
                    &self.bucket,
                    &key,
                    format!("the content's hash is {found}"),
                ));
            }
        }
        Ok(finished)
    }

    fn wait_for_cells(
        &self,
        cells_plan: &CellsPlan,
        finished: &BTreeMap<u32, FinishedCell>,
    ) -> Result<(), FleetError> {
        self.with_run(|run, queue| {
            run.check(&self.bucket)?;
            for name in self.bucket.list(&run.failed_folder())? {
                let cell = name.strip_prefix("cell-").and_then(|name| name.strip_suffix(".json"));
                if let Some(cell) =
                    cell.and_then(|cell| cell.parse::<u32>().ok()).filter(|cell| !finished.contains_key(cell))
                {
                    let key = format!("{}/{name}", run.failed_folder());
                    let FailedView { reason } =
                        documents::parse(&self.bucket, &key, &self.bucket.require(&key)?)?;
                    return Err(FleetError::Cell { cell, reason });
                }
            }
            let open = cells_plan.order.iter().filter(|cell| !finished.contains_key(cell));
            let items: Vec<Item> = open.map(|cell| Item::Cell(*cell)).collect();
            queue.into_iter().for_each(|queue| queue.keep_filled(&items));
            Ok(())
        })?;
        std::thread::sleep(pause(&self.bucket));
        Ok(())
    }
}
