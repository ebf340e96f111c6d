//! Cells on a worker: contributions by byte ranges from the bucket, shards and fields into it.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use slag_common::Hash32;

use super::dispatch::{Dispatcher, Item, Kind};
use super::documents::{self, CellsPlan};
use super::error::FleetError;
use super::merged::{self, Unpacked};
use super::prepared::{Prepared, of_encode};
use crate::blobs::Bucket;
use crate::encode::EncodeError;
use crate::encode::fleet_parts::{CellInWork, CellMaker, ObjectSink, RunContext, WriteObject};
use crate::memory::{MemoryPlan, Phase};
use crate::shard;

/// Keeps objects in a bucket.
pub(super) struct BucketObjects<'a>(pub(super) &'a Bucket);

impl ObjectSink for BucketObjects<'_> {
    fn put(&self, write: WriteObject<'_>) -> Result<(Hash32, u64), EncodeError> {
        let mut bytes = Vec::new();
        write(&mut bytes)?;
        let (hash, len_bytes) = (Hash32::of(&bytes), bytes.len() as u64);
        self.0.put_new(&documents::object_key(hash), bytes)?;
        Ok((hash, len_bytes))
    }
}

/// What cells are done with.
pub(super) struct CellWork<'a> {
    bucket: &'a Arc<Bucket>,
    prepared: &'a Prepared,
    plan: CellsPlan,
    unpacked: Unpacked,
    dispatcher: &'a dyn Dispatcher,
    n_at_once: usize,
    /// Cells whose records this worker put.
    pub(super) n_done: AtomicUsize,
}

impl<'a> CellWork<'a> {
    /// Brings what all views say about the cells.
    ///
    /// # Errors
    /// [`FleetError`].
    pub(super) fn fetch(
        bucket: &'a Arc<Bucket>,
        prepared: &'a Prepared,
        dispatcher: &'a dyn Dispatcher,
        mut memory: MemoryPlan,
        context: &RunContext<'_>,
    ) -> Result<Self, FleetError> {
        let plan = prepared.run.cells(bucket)?;
        let key = documents::merged_key(plan.merged);
        let bytes = bucket.require(&key)?;
        if Hash32::of(&bytes) != plan.merged {
            return Err(FleetError::damaged(bucket, &key, "its content has another hash"));
        }
        let of_cell = prepared.n_gaussians_of_cell();
        let n_gaussians = prepared.scene.len();
        let unpack = || merged::unpack(&bytes, bucket, &plan.views, n_gaussians, &of_cell);
        let unpacked = context.install(unpack).map_err(EncodeError::from)?;
        memory.views_are_done();
        memory.reserve(Phase::Always, "what all views say", bytes.len() as u64);
        let part_bytes = unpacked.index.largest_part_bytes();
        let rest_bytes = memory.rest(part_bytes)? - part_bytes;
        let cell_bytes = shard::largest_cell_bytes(&prepared.split, unpacked.table.dim()) + part_bytes;
        let n_more = (rest_bytes / cell_bytes.max(1)).min(context.pool().current_num_threads() as u64 - 1);
        let (n_at_once, n_done) = (1 + n_more as usize, AtomicUsize::new(0));
        Ok(Self { bucket, prepared, plan, unpacked, dispatcher, n_at_once, n_done })
    }

    /// Returns all cells, in the order of the plan.
    pub(super) fn all(&self) -> impl Iterator<Item = Item> + '_ {
        self.plan.order.iter().map(|cell| Item::Cell(*cell))
    }

    /// Returns the cells that are done.
    ///
    /// # Errors
    /// [`FleetError::Blob`].
    pub(super) fn done(&self) -> Result<BTreeSet<Item>, FleetError> {
        let names = self.bucket.list(&documents::cells_folder(self.plan.id))?;
        let cell = |name: &String| Some(Item::Cell(name.strip_suffix(".json")?.parse().ok()?));
        Ok(names.iter().filter_map(cell).collect())
    }

    /// Does the cells that there are; ends when no more are to be had at present. `n_open`: how many those are.
    ///
    /// # Errors
    /// [`FleetError`].
    pub(super) fn run(&self, n_open: usize, context: &RunContext<'_>) -> Result<(), FleetError> {
        let sink = BucketObjects(self.bucket);
        let maker = CellMaker {
            scene: &self.prepared.scene,
            split: &self.prepared.split,
            settings: &self.plan.settings,
            encoder_id: self.plan.encoder_id,
            merged: self.unpacked.merged(),
            sink: &sink,
            context,
        };
        let n_alone = context.workers().n_alone(n_open, self.n_at_once);
        let (n_begun, failure) = (AtomicUsize::new(0), Mutex::new(None));
        let is_stopped = || {
            let has_failed = failure.lock().unwrap_or_else(PoisonError::into_inner).is_some();
            context.is_cancelled() || has_failed
        };
        let work = || {
            let mut in_work = CellInWork::empty(self.unpacked.table.dim());
            while !is_stopped() {
                let Some(item) = self.dispatcher.take(Kind::Cell) else { break };
                let is_alone = n_begun.fetch_add(1, Ordering::Relaxed) < n_alone;
                if let Item::Cell(cell) = item
                    && let Err(error) = self.cell(cell, is_alone, &maker, &mut in_work)
                {
                    failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                    break;
                }
                self.dispatcher.done(item);
            }
        };
        std::thread::scope(|scope| (0..self.n_at_once).for_each(|_| drop(scope.spawn(work))));
        failure.into_inner().unwrap_or_else(PoisonError::into_inner).map_or(Ok(()), Err)
    }

    fn cell(
        &self,
        cell: u32,
        is_alone: bool,
        maker: &CellMaker<'_>,
        in_work: &mut CellInWork,
    ) -> Result<(), FleetError> {
        let key = documents::cell_key(self.plan.id, cell);
        if cell as usize >= self.prepared.split.cells.len() || self.bucket.len_of(&key)?.is_some() {
            return Ok(());
        }
        in_work.clear();
        let (index, workers) = (&self.unpacked.index, maker.context.workers());
        let parts = index.parts();
        let of_cell = parts.partition_point(|part| part.cell_id < cell)
            ..parts.partition_point(|part| part.cell_id <= cell);
        for part in of_cell {
            // The network is waited for on no thread of the processor.
            let raw = index.read(part..part + 1).map_err(EncodeError::from)?;
            let add = || -> Result<(), EncodeError> {
                for contributions in index.transpose(&raw, &self.unpacked.table)? {
                    maker.add_part(contributions, in_work)?;
                }
                Ok(())
            };
            workers.run(is_alone, add).map_err(of_encode)?;
        }
        let finished = workers.run(is_alone, || maker.finish_cell(cell, in_work)).map_err(of_encode)?;
        if self.bucket.put_new(&key, documents::to_bytes(&finished)?)? {
            self.n_done.fetch_add(1, Ordering::Relaxed);
        }
        Ok(())
    }
}
