//! Cells on their way from contributions to shards.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use slag_common::landmarks::BuiltLandmarks;
use slag_common::manifest::{CellRecord, ShardRecord};
use slag_common::photo_poses::BuiltPhotoPoses;
use slag_common::shard::Profile;
use slag_common::{Gaussians, Hash32};

use super::context::RunContext;
use super::error::EncodeError;
use crate::cells::CellSplit;
use crate::codebook::ScoreMetricContext;
use crate::lanes::Lanes;
use crate::lift::published::extra_field;
use crate::lift::refine::Refinement;
use crate::lift::{CellField, ContributionError, ContributionIndex, PartContributions, RegionTable};
use crate::objects::SceneObjects;
use crate::occupancy::SceneOccupancy;
use crate::shard::{BuiltShard, CellEmbeddings, CellExtras, ShardBuilder, ShardSettings};
use crate::store::Store;

pub(super) struct CellMaker<'a> {
    pub(super) scene: &'a Gaussians,
    pub(super) split: &'a CellSplit,
    pub(super) settings: &'a ShardSettings,
    pub(super) encoder_id: Hash32,
    pub(super) table: RegionTable,
    pub(super) refinement: Refinement,
    pub(super) objects: Option<SceneObjects>,
    pub(super) occupancy: Option<SceneOccupancy>,
    pub(super) score_context: ScoreMetricContext,
    /// Camera poses by cell, if the shards store them.
    pub(super) photo_poses: Option<Vec<BuiltPhotoPoses>>,
    pub(super) landmarks: Option<Vec<BuiltLandmarks>>,
    pub(super) store: &'a Store,
    pub(super) context: &'a RunContext<'a>,
}

#[derive(Clone, Copy)]
pub(super) struct CellsBudget {
    pub(super) group_bytes: u64,
    pub(super) n_at_once: usize,
}

/// A cell while its parts are lifted.
struct CellInWork {
    embeddings: CellEmbeddings,
    fields: Vec<(String, Hash32)>,
}

impl CellInWork {
    fn empty(dim: usize) -> Self {
        let embeddings = CellEmbeddings { dim, vectors: Vec::new(), has_evidence: Vec::new() };
        Self { embeddings, fields: Vec::new() }
    }
}

/// A cell whose shards are in the store.
#[derive(Debug)]
pub(super) struct FinishedCell {
    pub(super) record: CellRecord,
    pub(super) fields: Vec<(String, Hash32)>,
    pub(super) n_subspaces: u32,
    pub(super) n_without_evidence: u64,
    /// Over Gaussians with evidence: sums of mean score and mean squared score, and their number.
    pub(super) score_sums: [f64; 3],
}

impl CellMaker<'_> {
    /// Lifts cells and makes their shards, several at once.
    pub(super) fn build(
        &self,
        index: &ContributionIndex,
        budget: CellsBudget,
    ) -> Result<Vec<FinishedCell>, EncodeError> {
        let context = self.context;
        // A large cell's vectors are allocated once and reused, neither copied nor cleared.
        let free = (0..budget.n_at_once).map(|_| CellInWork::empty(self.table.dim())).collect();
        let lent = Lanes::new([(0, free)]);
        let take_emptied = || {
            let mut cell = lent.take();
            cell.embeddings.has_evidence.clear();
            cell.fields.clear();
            cell
        };
        let finished: Mutex<BTreeMap<u32, Result<FinishedCell, EncodeError>>> = Mutex::default();
        let has_failed = AtomicBool::new(false);
        let is_stopped = || context.is_cancelled() || has_failed.load(Ordering::Relaxed);
        let workers = &context.workers;
        let n_alone = workers.n_alone(self.split.cells.len(), budget.n_at_once);
        std::thread::scope(|scope| -> Result<(), EncodeError> {
            let mut parts = context.install(|| index.transposed_parts(&self.table, budget.group_bytes));
            let mut next_part = || context.time("merge", || context.install(|| parts.next()));
            let mut cell = take_emptied();
            while let Some(contributions) = next_part() {
                if is_stopped() {
                    break;
                }
                let contributions = contributions?;
                let cell_id = contributions.part.cell_id;
                if contributions.part.locals.end < self.split.cells[cell_id as usize].gaussians.len() {
                    // Large cells come in parts, so that only one part is held.
                    context.install(|| self.add_part(contributions, &mut cell))?;
                    continue;
                }
                let (finished, has_failed) = (&finished, &has_failed);
                let work = move || {
                    if !is_stopped() {
                        let added = self.add_part(contributions, &mut cell);
                        let result = added.and_then(|()| self.finish(cell_id, &mut cell));
                        has_failed.fetch_or(result.is_err(), Ordering::Relaxed);
                        finished.lock().unwrap_or_else(PoisonError::into_inner).insert(cell_id, result);
                        context.progress.advance(1);
                    }
                    drop(cell);
                };
                scope.spawn(move || workers.run((cell_id as usize) < n_alone, work));
                cell = take_emptied();
            }
            Ok(())
        })?;
        let finished = finished.into_inner().unwrap_or_else(PoisonError::into_inner);
        let finished = finished.into_values().collect::<Result<_, _>>()?;
        if context.is_cancelled() { Err(ContributionError::Cancelled.into()) } else { Ok(finished) }
    }

    fn add_part(
        &self,
        mut contributions: PartContributions,
        cell: &mut CellInWork,
    ) -> Result<(), EncodeError> {
        let part = contributions.part.clone();
        let gaussians = &self.split.cells[part.cell_id as usize].gaussians;
        let CellInWork { embeddings: cell, fields, .. } = cell;
        let len = cell.vectors.len().max(gaussians.len() * cell.dim);
        cell.vectors.reserve_exact(len - cell.vectors.len());
        cell.vectors.resize(len, 0.0);
        let vectors = &mut cell.vectors[part.locals.start * cell.dim..part.locals.end * cell.dim];
        let field = self.context.time("lift", || {
            self.refinement.apply(&mut contributions, &gaussians[part.locals.clone()]);
            CellField::new(gaussians[part.locals.clone()].to_vec(), contributions, &self.table, vectors)
        });
        cell.has_evidence.extend((0..field.len()).map(|k| field.has_evidence(k)));
        let (hash, _) = self.context.time("write", || self.store.put_object(|out| field.write(out)))?;
        fields.push((extra_field(part.cell_id, part.number), hash));
        Ok(())
    }

    fn finish(&self, cell_id: u32, in_work: &mut CellInWork) -> Result<FinishedCell, EncodeError> {
        let cell = &self.split.cells[cell_id as usize];
        let Self { scene, settings, encoder_id, score_context, .. } = self;
        let occupancy = self.occupancy.as_ref().map(|scene| scene.cells[cell_id as usize].view());
        let none = BuiltPhotoPoses::default();
        let photo_poses = self.photo_poses.as_ref().map_or(&none, |of_cells| &of_cells[cell_id as usize]);
        let objects = self.objects.as_ref();
        let landmarks = self.landmarks.as_ref().and_then(|of_cells| of_cells[cell_id as usize].view());
        let extras = CellExtras { objects, occupancy, photo_poses: photo_poses.view(), landmarks };
        let embeddings = &in_work.embeddings;
        let made = self.context.time("codebook", || {
            ShardBuilder { scene, encoder_id: *encoder_id, score_context, settings }
                .build(cell_id, cell, embeddings, extras)
        });
        let record = |shard: &BuiltShard| -> Result<(Profile, ShardRecord), EncodeError> {
            let (hash, len_bytes) = self.context.time("write", || self.store.put_bytes(&shard.bytes))?;
            let record = ShardRecord {
                hash,
                len_bytes,
                n_centroids: made.n_centroids,
                score_error_bound: shard.score_error_bound,
                score_errors: shard.score_errors,
                position_error: made.position_error,
            };
            Ok((shard.profile, record))
        };
        let shards = made.shards.iter().map(record).collect::<Result<_, EncodeError>>()?;
        let n_with = (cell.gaussians.len() - made.n_without_evidence) as f64;
        Ok(FinishedCell {
            record: CellRecord {
                cell_id,
                bounds: cell.bounds,
                n_gaussians: cell.gaussians.len() as u32,
                shards,
            },
            fields: std::mem::take(&mut in_work.fields),
            n_subspaces: made.n_subspaces,
            n_without_evidence: made.n_without_evidence as u64,
            score_sums: [made.moments.mean * n_with, made.moments.mean_square * n_with, n_with],
        })
    }
}
