//! The third step: the contributions of all views become objects, fields and shards of every cell.
//!
//! Contributions are read cell by cell. As many cells as the memory plan holds are lifted, coded and cut into shards
//! at once. A cell's bytes do not depend on the others'.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use slag_common::landmarks::BuiltLandmarks;
use slag_common::manifest::{Calibration, CellRecord, ShardRecord};
use slag_common::photo_poses::BuiltPhotoPoses;
use slag_common::shard::{Additions, Profile};
use slag_common::{Hash32, View};

use super::error::EncodeError;
use super::inputs;
use super::plan::Plan;
use super::report::ViewsReport;
use super::view::{ViewRecord, ViewSink};
use super::views::DoneViews;
use crate::codebook::{ScoreMetric, ScoreMetricContext, TextBank};
use crate::ingest;
use crate::lanes::Lanes;
use crate::lift::field::{EXTRA_AGGREGATION, EXTRA_REGIONS, extra_field};
use crate::lift::photos::{self, Photo};
use crate::lift::refine::{PendingRefinement, Refinement};
use crate::lift::{
    Aggregation, CellField, ContributionError, ContributionIndex, PartContributions, RegionTable,
    SceneContributions,
};
use crate::memory::Phase;
use crate::objects::{self, Object, ObjectsReport, SceneObjects};
use crate::occupancy::{OccupancyReport, SceneOccupancy};
use crate::shard::{self, BuiltShard, CellEmbeddings, ShardBuilder};
use crate::store::Extras;

pub(super) struct BuiltCells {
    pub(super) cells: Vec<FinishedCell>,
    pub(super) n_entries_of_cell: Vec<u64>,
    pub(super) extras: Extras,
    pub(super) objects: Option<ObjectsReport>,
    pub(super) occupancy: Option<OccupancyReport>,
    pub(super) n_views_without_masks: usize,
    pub(super) n_masks: usize,
    pub(super) n_regions: usize,
    pub(super) n_entries: u64,
    pub(super) views: ViewsReport,
}

impl BuiltCells {
    pub(super) fn n_without_evidence(&self) -> u64 {
        self.cells.iter().map(|cell| cell.n_without_evidence).sum()
    }

    /// Mean and spread of the text bank's scores over all cells.
    pub(super) fn calibration(&self) -> Calibration {
        let total = |of: usize| self.cells.iter().map(|cell| cell.score_sums[of]).sum::<f64>();
        let [sum, squares, n] = [0, 1, 2].map(total);
        let mean = sum / n.max(1.0);
        let variance = (squares / n.max(1.0) - mean * mean).max(0.0);
        Calibration { score_mean: mean as f32, score_spread: variance.sqrt() as f32 }
    }
}

/// Merges the contributions of the used views, builds all cells and puts their objects into the store.
pub(super) fn build_cells(
    plan: &Plan<'_>,
    views: &mut DoneViews<'_>,
    occupancy: Option<SceneOccupancy>,
    landmarks: Option<Vec<BuiltLandmarks>>,
) -> Result<BuiltCells, EncodeError> {
    let Plan { inputs, settings, .. } = *plan;
    let opened = plan.context.install(|| Opened::of(plan, views, occupancy.as_ref()))?;
    let Opened { index, table, score_context, photos, pass_bytes, group_bytes, n_at_once } = opened;
    let scene = SceneContributions {
        index: &index,
        gaussians: &inputs.scene,
        split: &inputs.split,
        standing: &inputs.standing,
        photos: &photos,
        group_bytes: pass_bytes,
        cancel: plan.context.cancel,
    };
    // Before refinement adds superpoints as regions.
    let (n_masks, n_regions) = (table.n_masks(), table.len());
    let (table, refinement, mut objects) = refine(plan, &scene, table, &score_context)?;
    if let Some(found) = &mut objects
        && settings.cells.shards.have_appearance()
    {
        found.thumbnails = thumbnails(plan, &found.objects, views)?;
    }
    let mut extras = put_extras(plan, &table)?;
    plan.context.begin_phase(Phase::Cells);
    plan.context.progress.begin("cells", "cell", inputs.split.cells.len() as u64, 0);
    let has_poses = settings.cells.photo_poses;
    let maker = CellMaker {
        plan,
        table,
        refinement,
        objects,
        occupancy,
        score_context,
        landmarks,
        photo_poses: has_poses.then(|| shard::photo_poses(&inputs.split, &views.used)),
    };
    let mut cells = maker.build(&index, group_bytes, n_at_once)?;
    plan.context.progress.end();
    extras.extend(cells.iter_mut().flat_map(|cell| std::mem::take(&mut cell.fields)));
    let mut n_entries_of_cell = vec![0; inputs.split.cells.len()];
    index.parts.iter().for_each(|part| n_entries_of_cell[part.cell_id as usize] += part.n_entries);
    Ok(BuiltCells {
        cells,
        n_entries_of_cell,
        extras,
        objects: maker.objects.map(|objects| objects.report),
        occupancy: maker.occupancy.map(|occupancy| occupancy.report),
        n_views_without_masks: index.views.iter().filter(|view| view.n_masks == 0).count(),
        n_masks,
        n_regions,
        n_entries: index.n_entries(),
        views: views_report(views, &index),
    })
}

/// Returns the regions, with superpoints that refinement added, and the objects.
fn refine(
    plan: &Plan<'_>,
    scene: &SceneContributions<'_>,
    table: RegionTable,
    score_context: &ScoreMetricContext,
) -> Result<(RegionTable, Refinement, Option<SceneObjects>), EncodeError> {
    let settings = plan.settings;
    plan.context.begin_phase(Phase::Superpoints);
    plan.context.progress.begin("objects", "step", 3, 0);
    let begin = || plan.context.install(|| PendingRefinement::begin(settings.aggregation, scene, table));
    let pending = plan.context.time("superpoints", begin)?;
    plan.context.progress.advance(1);
    // From all masks alike, whatever their weight in the refinement.
    plan.context.begin_phase(Phase::Objects);
    let (views, superpoints) = (pending.table(), pending.superpoints());
    let find = || plan.context.install(|| objects::find(scene, views, superpoints, score_context));
    let objects = settings.cells.objects.then(|| plan.context.time("objects", find)).transpose()?;
    plan.context.progress.advance(1);
    if let Some(found) = &objects {
        plan.context.progress.objects(&mut found.objects.iter().map(Object::found));
    }
    plan.context.begin_phase(Phase::Refine);
    let object_of = objects.as_ref().map_or(&[][..], |objects| &objects.object_of);
    let finish = || plan.context.install(|| pending.finish(scene, object_of));
    let (table, refinement) = plan.context.time("refine", finish)?;
    plan.context.progress.advance(1);
    plan.context.progress.end();
    Ok((table, refinement, objects))
}

fn thumbnails(
    plan: &Plan<'_>,
    objects: &[Object],
    views: &DoneViews<'_>,
) -> Result<Vec<Vec<u8>>, EncodeError> {
    let load = |view: &View| {
        let photo = ingest::load_image(view)?.image;
        plan.job.check_unchanged(view, plan.segmenter.as_ref())?;
        Ok::<_, EncodeError>(photo)
    };
    let cut =
        || objects::cut_thumbnails(objects, &views.used, load, plan.context.progress, plan.context.cancel);
    let (thumbnails, fault) = plan.context.time("thumbnails", || plan.context.install(cut));
    if plan.context.is_cancelled() {
        return Err(ContributionError::Cancelled.into());
    }
    if let Some(fault) = fault {
        let n = thumbnails.iter().filter(|thumbnail| thumbnail.is_empty()).count();
        tracing::warn!("{n} objects have no picture of their own, as a photo cannot be read: {fault}");
    }
    Ok(thumbnails)
}

fn put_extras(plan: &Plan<'_>, table: &RegionTable) -> Result<Extras, EncodeError> {
    let Plan { store, settings, .. } = *plan;
    let mut extras = Extras::new();
    if settings.aggregation != Aggregation::default() {
        let record = serde_json::to_vec(&settings.aggregation).map_err(std::io::Error::from)?;
        extras.insert(EXTRA_AGGREGATION.into(), store.put_bytes(&record)?.0);
    }
    let regions = plan.context.install(|| store.put_object(|out| table.write(out)))?.0;
    extras.insert(EXTRA_REGIONS.into(), regions);
    Ok(extras)
}

fn text_bank(plan: &Plan<'_>) -> TextBank {
    let models = plan.engines.models;
    plan.context.time("texts", || match models.text_encoder(plan.engines.session) {
        Ok(mut encoder) => TextBank::of_model(&mut *encoder),
        Err(e) => {
            tracing::warn!("{e}; codebooks are made for queries in all directions alike");
            TextBank::directions(models.dim())
        }
    })
}

fn views_report(views: &DoneViews<'_>, index: &ContributionIndex) -> ViewsReport {
    let record = |view: &&View| -> ViewRecord { views.records.get(&view.name).copied().unwrap_or_default() };
    let used = &views.used;
    ViewsReport {
        view: used.iter().map(|view| view.name.clone()).collect(),
        raster_width_px: used.iter().map(|view| record(view).raster_width_px).collect(),
        n_masks: index.views.iter().map(|view| view.n_masks).collect(),
        n_regions: index.views.iter().map(|view| view.file.n_regions).collect(),
        n_entries: index.views.iter().map(|view| view.file.n_entries).collect(),
        secs: used.iter().map(|view| (f64::from(record(view).secs) * 1e3).round() / 1e3).collect(),
    }
}

/// Contributions of the used views, and memory for the passes over them.
struct Opened {
    index: ContributionIndex,
    table: RegionTable,
    score_context: ScoreMetricContext,
    photos: Vec<Photo>,
    /// Bytes of contributions that a pass of refinement or objects may hold.
    pass_bytes: u64,
    /// The same while cells are made, `n_at_once` of them.
    group_bytes: u64,
    n_at_once: usize,
}

impl Opened {
    fn of(
        plan: &Plan<'_>,
        views: &mut DoneViews<'_>,
        occupancy: Option<&SceneOccupancy>,
    ) -> Result<Self, EncodeError> {
        let (models, job, split) = (plan.engines.models, &plan.job, &plan.inputs.split);
        let bank = text_bank(plan);
        let n_gaussians: Vec<usize> = split.cells.iter().map(|cell| cell.gaussians.len()).collect();
        let open = |used: &[&View]| {
            let paths: Vec<PathBuf> = used.iter().map(|view| job.contributions_path(&view.name)).collect();
            plan.context.time("merge", || ContributionIndex::open(&paths, models.dim(), &n_gaussians))
        };
        let (mut index, mut table) = open(&views.used)?;
        if views.leave_out_blind(&index) {
            (index, table) = open(&views.used)?;
        }
        let photo = |(view, n_masks): (&&View, usize)| -> Result<Photo, ContributionError> {
            let outlines = photos::read_outlines(&job.outlines_path(&view.name), n_masks)?;
            Ok(Photo { name: view.name.clone(), outlines })
        };
        let photos: Vec<Photo> = views
            .used
            .iter()
            .zip(index.views.iter().map(|view| view.n_masks))
            .map(photo)
            .collect::<Result<_, _>>()?;
        let levels = photos.iter().flat_map(|photo| &photo.outlines).map(|outline| outline.level as u8);
        table.set_levels(levels.collect());
        let mut memory = plan.memory.clone();
        memory.views_are_done();
        table.reserve(&mut memory);
        occupancy.iter().for_each(|occupancy| occupancy.reserve(&mut memory));
        index.reserve(&mut memory);
        let (aggregation, n_entries) = (&plan.settings.aggregation, index.n_entries());
        Refinement::reserve_contributions(&mut memory, aggregation, table.len(), n_entries);
        if plan.settings.cells.objects {
            objects::reserve_contributions(&mut memory, n_entries);
            if plan.settings.cells.shards.have_appearance() {
                inputs::reserve_thumbnails(&mut memory, &plan.inputs.views, plan.settings.run.threads);
            }
        }
        let pass_bytes = memory.rest(index.largest_part_bytes())?;
        let cell_bytes = shard::largest_cell_bytes(split, models.dim()) + index.largest_part_bytes();
        // Cells come second: contributions that are not kept in memory are read six times. Memory of superpoints and
        // objects is free again by then.
        let rest_bytes = memory.rest_of(Phase::Cells);
        let spare_bytes = rest_bytes - index.budget_bytes(pass_bytes);
        let n_more = (spare_bytes / cell_bytes.max(1))
            .min(plan.context.workers.shared.current_num_threads() as u64 - 1);
        let group_bytes = (rest_bytes - n_more * cell_bytes).min(pass_bytes);
        let score_context = plan.context.time("texts", || {
            let metric = ScoreMetric::new(models.dim(), &bank);
            let spread = metric.spread(table.mask_vectors());
            ScoreMetricContext { metric, bank, spread }
        });
        let n_at_once = 1 + n_more as usize;
        tracing::debug!("{n_at_once} cells at once, {cell_bytes} bytes each");
        Ok(Self { index, table, score_context, photos, pass_bytes, group_bytes, n_at_once })
    }
}

struct CellMaker<'a> {
    plan: &'a Plan<'a>,
    table: RegionTable,
    refinement: Refinement,
    objects: Option<SceneObjects>,
    occupancy: Option<SceneOccupancy>,
    score_context: ScoreMetricContext,
    /// Camera poses by cell, if the shards store them.
    photo_poses: Option<Vec<BuiltPhotoPoses>>,
    landmarks: Option<Vec<BuiltLandmarks>>,
}

/// A cell while its parts are lifted.
struct CellInWork {
    embeddings: CellEmbeddings,
    fields: Vec<(String, Hash32)>,
}

/// A cell whose shards are in the store.
#[derive(Debug)]
pub(super) struct FinishedCell {
    pub(super) record: CellRecord,
    fields: Vec<(String, Hash32)>,
    /// Of its residual code.
    pub(super) n_subspaces: u32,
    n_without_evidence: u64,
    /// Over Gaussians with evidence: sums of mean score and mean squared score, and their number.
    score_sums: [f64; 3],
}

impl CellMaker<'_> {
    /// Lifts cells and makes their shards, several at once.
    fn build(
        &self,
        index: &ContributionIndex,
        group_bytes: u64,
        n_at_once: usize,
    ) -> Result<Vec<FinishedCell>, EncodeError> {
        let context = self.plan.context;
        // A large cell's vectors are allocated once and reused, neither copied nor cleared.
        let empty = |_| CellInWork {
            embeddings: CellEmbeddings {
                dim: self.table.dim(),
                vectors: Vec::new(),
                has_evidence: Vec::new(),
            },
            fields: Vec::new(),
        };
        let lent = Lanes::new([(0, (0..n_at_once).map(empty).collect())]);
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
        let n_alone = workers.n_alone(self.plan.inputs.split.cells.len(), n_at_once);
        std::thread::scope(|scope| -> Result<(), EncodeError> {
            let mut parts = context.install(|| index.transposed_parts(&self.table, group_bytes));
            let mut next_part = || context.time("merge", || context.install(|| parts.next()));
            let mut cell = take_emptied();
            while let Some(contributions) = next_part() {
                if is_stopped() {
                    break;
                }
                let contributions = contributions?;
                let cell_id = contributions.part.cell_id;
                if contributions.part.locals.end
                    < self.plan.inputs.split.cells[cell_id as usize].gaussians.len()
                {
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
        let gaussians = &self.plan.inputs.split.cells[part.cell_id as usize].gaussians;
        let CellInWork { embeddings: cell, fields, .. } = cell;
        let len = cell.vectors.len().max(gaussians.len() * cell.dim);
        cell.vectors.reserve_exact(len - cell.vectors.len());
        cell.vectors.resize(len, 0.0);
        let vectors = &mut cell.vectors[part.locals.start * cell.dim..part.locals.end * cell.dim];
        let field = self.plan.context.time("lift", || {
            self.refinement.apply(&mut contributions, &gaussians[part.locals.clone()]);
            CellField::new(gaussians[part.locals.clone()].to_vec(), contributions, &self.table, vectors)
        });
        cell.has_evidence.extend((0..field.len()).map(|k| field.has_evidence(k)));
        let (hash, _) =
            self.plan.context.time("write", || self.plan.store.put_object(|out| field.write(out)))?;
        fields.push((extra_field(part.cell_id, part.number), hash));
        Ok(())
    }

    fn finish(&self, cell_id: u32, in_work: &mut CellInWork) -> Result<FinishedCell, EncodeError> {
        let cell = &self.plan.inputs.split.cells[cell_id as usize];
        let Plan { inputs, settings, engines, .. } = self.plan;
        let occupancy = self.occupancy.as_ref().map(|scene| scene.cells[cell_id as usize].view());
        let none = BuiltPhotoPoses::default();
        let photo_poses = self.photo_poses.as_ref().map_or(&none, |of_cells| &of_cells[cell_id as usize]);
        let landmarks = self.landmarks.as_ref().and_then(|of_cells| of_cells[cell_id as usize].view());
        let photo_poses = photo_poses.view();
        let additions = Additions { occupancy, photo_poses, landmarks, ..Additions::default() };
        let embeddings = &in_work.embeddings;
        let made = self.plan.context.time("codebook", || {
            ShardBuilder {
                scene: &inputs.scene,
                encoder_id: Hash32(engines.models.encoder_id().hash()),
                score_context: &self.score_context,
                settings: &settings.cells.shards,
            }
            .build(cell_id, cell, embeddings, self.objects.as_ref(), additions)
        });
        let record = |shard: &BuiltShard| -> Result<(Profile, ShardRecord), EncodeError> {
            let (hash, len_bytes) =
                self.plan.context.time("write", || self.plan.store.put_bytes(&shard.bytes))?;
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
