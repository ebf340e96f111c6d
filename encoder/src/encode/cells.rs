//! From the contributions of all views to the objects of every cell, within the budget.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use slag_common::manifest::{Calibration, CellRecord, ShardRecord};
use slag_common::shard::Profile;
use slag_common::{Gaussians, Hash32, View};
use slag_models::ModelDir;

use super::job::Job;
use super::{EncodeError, EncodeSettings, StageTimes};
use crate::cells::CellSplit;
use crate::codebook::{ScoreMetric, ScoreMetricContext, TextBank};
use crate::lift::photos::{self, Photo};
use crate::lift::published::{EXTRA_AGGREGATION, EXTRA_REGIONS, extra_field};
use crate::lift::refine::Refinement;
use crate::lift::{
    Aggregation, CellField, ContributionError, ContributionIndex, PartContributions, RegionTable,
};
use crate::objects::{self, ObjectsReport, SceneObjects};
use crate::progress::Progress;
use crate::shard::{self, BuiltShard, CellEmbeddings};
use crate::store::{Extras, Store};

/// Returns the bytes that the largest cell takes while it is built.
pub(super) fn largest_cell_bytes(split: &CellSplit, dim: usize) -> u64 {
    let largest = split.cells.iter().map(|cell| cell.gaussians.len()).max().unwrap_or(0);
    shard::working_bytes(largest, dim)
}

/// Returns what cell and index leave of `available_bytes` for contributions, which need at least `contributions_bytes`.
pub(super) fn check_memory(
    available_bytes: u64,
    cell_bytes: u64,
    index_bytes: u64,
    contributions_bytes: u64,
) -> Result<u64, EncodeError> {
    let needed_bytes = cell_bytes + index_bytes + contributions_bytes;
    if needed_bytes > available_bytes {
        return Err(EncodeError::Memory { available_bytes, needed_bytes, cell_bytes, index_bytes });
    }
    Ok(available_bytes - cell_bytes - index_bytes)
}

/// Builds the cells of a scene whose views are all done.
pub(super) struct CellBuilder<'a> {
    settings: &'a EncodeSettings,
    store: &'a Store,
    scene: &'a Gaussians,
    split: &'a CellSplit,
    encoder_id: Hash32,
    times: &'a StageTimes,
    index: ContributionIndex,
    table: RegionTable,
    /// What errors of scores are measured by.
    score_context: ScoreMetricContext,
    /// Bytes there are for the contributions of a group of cells.
    group_bytes: u64,
    /// Each view's masks in its photo.
    photos: Vec<Photo>,
}

/// What was built.
pub(super) struct BuiltCells {
    pub(super) records: Vec<CellRecord>,
    /// Half bytes a Gaussian of each cell's residual code.
    pub(super) n_subspaces: Vec<u32>,
    pub(super) extras: Extras,
    pub(super) n_without_evidence: u64,
    /// Sums over the Gaussians with evidence of mean score and mean squared score, and how many they are.
    score_sums: [f64; 3],
    /// What was found, where objects were looked for.
    pub(super) objects: Option<ObjectsReport>,
}

impl BuiltCells {
    /// Returns how the bank of texts scores in all cells.
    pub(super) fn calibration(&self) -> Calibration {
        let [sum, squares, n] = self.score_sums;
        let mean = sum / n.max(1.0);
        let variance = (squares / n.max(1.0) - mean * mean).max(0.0);
        Calibration { score_mean: mean as f32, score_spread: variance.sqrt() as f32 }
    }
}

impl<'a> CellBuilder<'a> {
    /// Opens what the job keeps of some views, in the order of their names.
    ///
    /// # Errors
    /// [`EncodeError::Sums`], [`EncodeError::Memory`].
    pub(super) fn open(
        settings: &'a EncodeSettings,
        store: &'a Store,
        scene: &'a Gaussians,
        split: &'a CellSplit,
        (job, views): (&Job<'_>, &[&View]),
        (models, bank): (&ModelDir, TextBank),
        times: &'a StageTimes,
    ) -> Result<Self, EncodeError> {
        let n_gaussians: Vec<usize> = split.cells.iter().map(|cell| cell.gaussians.len()).collect();
        let contributions_paths: Vec<PathBuf> =
            views.iter().map(|view| job.contributions_path(&view.name)).collect();
        let (index, mut table) = times
            .time("merge", || ContributionIndex::open(&contributions_paths, models.dim(), &n_gaussians))?;
        let photo = |(view, n_masks): (&&View, usize)| -> Result<Photo, ContributionError> {
            let outlines = photos::read_outlines(&job.outlines_path(&view.name), n_masks)?;
            Ok(Photo { name: view.name.clone(), outlines })
        };
        let photos: Vec<Photo> =
            views.iter().zip(index.n_masks_of_view()).map(photo).collect::<Result<_, _>>()?;
        let levels = photos.iter().flat_map(|photo| &photo.outlines).map(|outline| outline.level as u8);
        table.set_levels(levels.collect());
        let group_bytes = check_memory(
            settings.memory_bytes,
            largest_cell_bytes(split, models.dim()),
            table.len_bytes()
                + index.len_bytes()
                + Refinement::len_bytes(&settings.aggregation, scene.len(), table.len()),
            index.largest_part_bytes(),
        )?;
        let encoder_id = Hash32(models.encoder_id().hash());
        let score_context = times.time("texts", || {
            let metric = ScoreMetric::new(models.dim(), &bank);
            let spread = metric.spread(table.mask_vectors());
            ScoreMetricContext { metric, bank, spread }
        });
        Ok(Self {
            settings,
            store,
            scene,
            split,
            encoder_id,
            times,
            index,
            table,
            score_context,
            group_bytes,
            photos,
        })
    }

    /// Finds the objects of the scene, where they are asked for; none if cancelled.
    fn objects(&self, cancel: &AtomicBool) -> Result<Option<SceneObjects>, EncodeError> {
        if !self.settings.objects {
            return Ok(None);
        }
        let scene = objects::Scene {
            index: &self.index,
            table: &self.table,
            gaussians: self.scene,
            split: self.split,
            photos: &self.photos,
            score_context: &self.score_context,
            group_bytes: self.group_bytes,
            cancel,
        };
        Ok(self.times.time("objects", || objects::find(&scene))?)
    }

    pub(super) fn index(&self) -> &ContributionIndex {
        &self.index
    }

    pub(super) fn n_views_without_masks(&self) -> usize {
        self.index.n_views_without_masks()
    }

    pub(super) fn n_masks(&self) -> usize {
        self.table.n_masks()
    }

    pub(super) fn n_regions(&self) -> usize {
        self.table.len()
    }

    pub(super) fn n_entries(&self) -> u64 {
        self.index.n_entries()
    }

    /// Builds all cells and puts their objects into the store; `None` if cancelled.
    ///
    /// # Errors
    /// [`EncodeError`].
    pub(super) fn build(
        &mut self,
        progress: &dyn Progress,
        cancel: &AtomicBool,
    ) -> Result<Option<BuiltCells>, EncodeError> {
        let mut built = BuiltCells {
            records: Vec::new(),
            n_subspaces: Vec::new(),
            extras: Extras::new(),
            n_without_evidence: 0,
            score_sums: [0.0; 3],
            objects: None,
        };
        // Of the masks as they are, before any counts less.
        let objects = self.objects(cancel)?;
        let aggregation = self.settings.aggregation;
        let refinement = self.times.time("refine", || {
            let contributions = (&self.index, &mut self.table);
            let scene = (self.scene, self.split);
            Refinement::prepare(aggregation, contributions, scene, &self.photos, self.group_bytes, cancel)
        })?;
        if cancel.load(Ordering::Relaxed) {
            return Ok(None);
        }
        if aggregation != Aggregation::PAPER {
            let record = serde_json::to_vec(&aggregation).map_err(std::io::Error::from)?;
            built.extras.insert(EXTRA_AGGREGATION.into(), self.store.put_bytes(&record)?.0);
        }
        let regions = self.store.put_object(|out| self.table.write(out))?.0;
        built.extras.insert(EXTRA_REGIONS.into(), regions);
        let dim = self.table.dim();
        let mut cell = CellEmbeddings { dim, vectors: Vec::new(), has_evidence: Vec::new() };
        for group in self.index.groups(self.group_bytes) {
            let contributions = self.times.time("merge", || {
                let raw = self.index.read(group)?;
                self.index.transpose(&raw, &self.table)
            })?;
            for contributions in contributions {
                if cancel.load(Ordering::Relaxed) {
                    return Ok(None);
                }
                let cell_id = contributions.part.cell_id;
                self.add_part(contributions, refinement.as_ref(), &mut cell, &mut built)?;
                if cell.has_evidence.len() == self.split.cells[cell_id as usize].gaussians.len() {
                    self.finish_cell(cell_id, &cell, objects.as_ref(), &mut built)?;
                    cell.has_evidence.clear();
                    progress.advance(1);
                }
            }
        }
        built.objects = objects.map(|objects| objects.report);
        Ok(Some(built))
    }

    /// Adds the next part's embeddings to its cell's, and publishes its field.
    fn add_part(
        &self,
        mut contributions: PartContributions,
        refinement: Option<&Refinement>,
        cell: &mut CellEmbeddings,
        built: &mut BuiltCells,
    ) -> Result<(), EncodeError> {
        let part = contributions.part.clone();
        let gaussians = &self.split.cells[part.cell_id as usize].gaussians;
        // Nothing is copied or cleared: the largest cell's vectors are taken once.
        let len = cell.vectors.len().max(gaussians.len() * cell.dim);
        cell.vectors.reserve_exact(len - cell.vectors.len());
        cell.vectors.resize(len, 0.0);
        let vectors = &mut cell.vectors[part.locals.start * cell.dim..part.locals.end * cell.dim];
        let field = self.times.time("lift", || {
            if let Some(refinement) = refinement {
                refinement.apply(&mut contributions, &gaussians[part.locals.clone()]);
            }
            CellField::new(gaussians[part.locals.clone()].to_vec(), contributions, &self.table, vectors)
        });
        cell.has_evidence.extend((0..field.len()).map(|k| field.has_evidence(k)));
        let (hash, _) = self.times.time("write", || self.store.put_object(|out| field.write(out)))?;
        built.extras.insert(extra_field(part.cell_id, part.number), hash);
        Ok(())
    }

    /// Makes a cell's codebook and shards of its embeddings.
    fn finish_cell(
        &self,
        cell_id: u32,
        embeddings: &CellEmbeddings,
        objects: Option<&SceneObjects>,
        built: &mut BuiltCells,
    ) -> Result<(), EncodeError> {
        let cell = &self.split.cells[cell_id as usize];
        let (scene, encoder_id, settings) = (self.scene, self.encoder_id, &self.settings.shards);
        let made = self.times.time("codebook", || {
            shard::build(scene, cell_id, cell, embeddings, encoder_id, &self.score_context, settings, objects)
        });
        let record = |shard: &BuiltShard| -> Result<(Profile, ShardRecord), EncodeError> {
            let (hash, len_bytes) = self.times.time("write", || self.store.put_bytes(&shard.bytes))?;
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
        built.n_subspaces.push(made.n_subspaces);
        built.n_without_evidence += made.n_without_evidence as u64;
        let n_with = (cell.gaussians.len() - made.n_without_evidence) as f64;
        let contributions = [made.moments.mean * n_with, made.moments.mean_square * n_with, n_with];
        built.score_sums.iter_mut().zip(contributions).for_each(|(all, of_cell)| *all += of_cell);
        built.records.push(CellRecord {
            cell_id,
            bounds: cell.bounds,
            n_gaussians: cell.gaussians.len() as u32,
            shards,
        });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_that_is_too_small_is_refused_with_what_is_needed() {
        assert_eq!(check_memory(100, 50, 20, 30).expect("enough"), 30);
        let message = check_memory(99, 50, 20, 30).expect_err("too small").to_string();
        assert!(
            message.contains("99 bytes, 100 are needed: 50") && message.contains("raise --memory"),
            "{message}"
        );
    }
}
