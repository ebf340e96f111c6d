//! A cell on its way from contributions to shards.

use slag_common::manifest::{CellRecord, ShardRecord};
use slag_common::photo_poses::BuiltPhotoPoses;
use slag_common::shard::Profile;
use slag_common::{Gaussians, Hash32};

use super::context::RunContext;
use super::error::EncodeError;
use crate::cells::CellSplit;
use crate::codebook::ScoreMetricContext;
use crate::lift::published::extra_field;
use crate::lift::refine::Refinement;
use crate::lift::{CellField, PartContributions, RegionTable};
use crate::objects::SceneObjects;
use crate::occupancy::SceneOccupancy;
use crate::shard::{BuiltShard, CellEmbeddings, CellExtras, ShardBuilder, ShardSettings};
use crate::store::Store;

/// What all views together say about every cell.
#[derive(Clone, Copy)]
pub(crate) struct Merged<'a> {
    pub(crate) table: &'a RegionTable,
    /// What errors of scores are measured by.
    pub(crate) score_context: &'a ScoreMetricContext,
    pub(crate) refinement: Option<&'a Refinement>,
    pub(crate) objects: Option<&'a SceneObjects>,
    pub(crate) occupancy: Option<&'a SceneOccupancy>,
}

/// Makes cells.
#[derive(Clone, Copy)]
pub(crate) struct CellMaker<'a> {
    pub(crate) scene: &'a Gaussians,
    pub(crate) split: &'a CellSplit,
    pub(crate) settings: &'a ShardSettings,
    pub(crate) encoder_id: Hash32,
    pub(crate) merged: Merged<'a>,
    pub(crate) store: &'a Store,
    pub(crate) context: &'a RunContext<'a>,
}

/// A cell whose parts are being lifted.
pub(crate) struct CellInWork {
    pub(super) embeddings: CellEmbeddings,
    /// Fields in the store, by name.
    pub(super) fields: Vec<(String, Hash32)>,
    /// Its photos, if its shards say where they were taken.
    pub(super) photo_poses: BuiltPhotoPoses,
}

impl CellInWork {
    pub(crate) fn empty(dim: usize) -> Self {
        let embeddings = CellEmbeddings { dim, vectors: Vec::new(), has_evidence: Vec::new() };
        Self { embeddings, fields: Vec::new(), photo_poses: BuiltPhotoPoses::default() }
    }

    /// Makes room for the next cell; the vectors of a large cell are allocated once and used again.
    pub(crate) fn clear(&mut self) {
        self.embeddings.has_evidence.clear();
        self.fields.clear();
        self.photo_poses = BuiltPhotoPoses::default();
    }
}

/// A cell whose shards are kept.
#[derive(Debug)]
pub(crate) struct FinishedCell {
    pub(crate) record: CellRecord,
    /// As of the cell in work.
    pub(crate) fields: Vec<(String, Hash32)>,
    pub(crate) n_subspaces: u32,
    pub(crate) n_without_evidence: u64,
    /// Sums over the Gaussians with evidence of mean score and mean squared score, and their number.
    pub(crate) score_sums: [f64; 3],
}

impl CellMaker<'_> {
    /// Adds the next part's embeddings to its cell's, and keeps its field.
    ///
    /// # Errors
    /// [`EncodeError`] if the field cannot be kept.
    pub(crate) fn add_part(
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
            if let Some(refinement) = self.merged.refinement {
                refinement.apply(&mut contributions, &gaussians[part.locals.clone()]);
            }
            CellField::new(gaussians[part.locals.clone()].to_vec(), contributions, self.merged.table, vectors)
        });
        cell.has_evidence.extend((0..field.len()).map(|k| field.has_evidence(k)));
        let (hash, _) = self.context.time("write", || self.store.put_object(|out| field.write(out)))?;
        fields.push((extra_field(part.cell_id, part.number), hash));
        Ok(())
    }

    /// Makes a cell's codebook and shards from its embeddings, and keeps the shards.
    ///
    /// # Errors
    /// [`EncodeError`] if a shard cannot be kept.
    pub(crate) fn finish_cell(
        &self,
        cell_id: u32,
        in_work: &mut CellInWork,
    ) -> Result<FinishedCell, EncodeError> {
        let cell = &self.split.cells[cell_id as usize];
        let Self { scene, settings, encoder_id, merged, .. } = *self;
        let Merged { score_context, objects, .. } = merged;
        let occupancy = merged.occupancy.map(|scene| scene.cells[cell_id as usize].view());
        let photo_poses = in_work.photo_poses.view();
        let extras = CellExtras { objects, occupancy, photo_poses };
        let embeddings = &in_work.embeddings;
        let made = self.context.time("codebook", || {
            ShardBuilder { scene, encoder_id, score_context, settings }
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
