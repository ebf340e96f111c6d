//! The third step: the contributions of all views become objects, fields and shards of every cell.
//!
//! Contributions are read cell by cell. Several cells at once are lifted and become codebooks and shards, as many as the
//! memory plan holds. A cell's bytes do not depend on the others'.

use std::path::PathBuf;

use slag_common::manifest::{Calibration, CellRecord};
use slag_common::{Hash32, View};

use super::cell::{FinishedCell, Merged};
use super::context::{Phase, RunContext};
use super::error::EncodeError;
use super::executor::CellsToBuild;
use super::here;
use super::plan::Plan;
use super::report::ViewsReport;
use super::sink::ViewRecord;
use super::views::DoneViews;
use crate::codebook::{ScoreMetric, ScoreMetricContext, TextBank};
use crate::lift::photos::{self, Photo};
use crate::lift::published::{EXTRA_AGGREGATION, EXTRA_REGIONS};
use crate::lift::refine::{Begun, Passes, Refinement, Subject};
use crate::lift::superpoint::Superpoints;
use crate::lift::{Aggregation, ContributionError, ContributionIndex, RegionTable};
use crate::memory;
use crate::objects::{self, Object, ObjectsReport, SceneObjects};
use crate::occupancy::{OccupancyReport, SceneOccupancy};
use crate::shard;
use crate::store::Extras;

/// The cells of a scene, all objects of them in the store.
pub(super) struct BuiltCells {
    /// Manifest records, by cell.
    pub(super) records: Vec<CellRecord>,
    /// Subspaces of each cell's residual code.
    pub(super) n_subspaces: Vec<u32>,
    /// Contributions of each cell.
    pub(super) n_entries: Vec<u64>,
    pub(super) extras: Extras,
    pub(super) n_without_evidence: u64,
    /// The search for objects, if there was one.
    pub(super) objects: Option<ObjectsReport>,
    pub(super) occupancy: Option<OccupancyReport>,
    pub(super) counts: Counts,
    /// Sums over the Gaussians with evidence of mean score and mean squared score, and their number.
    score_sums: [f64; 3],
}

/// The size of what the views found.
pub(super) struct Counts {
    pub(super) n_views_without_masks: usize,
    pub(super) n_masks: usize,
    pub(super) n_regions: usize,
    pub(super) n_entries: u64,
    pub(super) views: ViewsReport,
}

impl BuiltCells {
    fn add(&mut self, cell: FinishedCell) {
        self.records.push(cell.record);
        self.extras.extend(cell.fields);
        self.n_subspaces.push(cell.n_subspaces);
        self.n_without_evidence += cell.n_without_evidence;
        self.score_sums.iter_mut().zip(cell.score_sums).for_each(|(all, of_cell)| *all += of_cell);
    }

    /// Returns how the bank of texts scores in all cells.
    pub(super) fn calibration(&self) -> Calibration {
        let [sum, squares, n] = self.score_sums;
        let mean = sum / n.max(1.0);
        let variance = (squares / n.max(1.0) - mean * mean).max(0.0);
        Calibration { score_mean: mean as f32, score_spread: variance.sqrt() as f32 }
    }
}

/// Builds all cells and puts their objects into the store.
///
/// # Errors
/// [`EncodeError`].
pub(super) fn build_cells(
    plan: &Plan<'_>,
    views: &DoneViews<'_>,
    occupancy: Option<SceneOccupancy>,
    context: &RunContext<'_>,
) -> Result<BuiltCells, EncodeError> {
    let mut builder = context.install(|| {
        let bank = text_bank(plan, context);
        CellBuilder::open(plan, views, bank, occupancy, context)
    })?;
    context.progress().begin("cells", "cell", plan.inputs.split.cells.len() as u64, 0);
    let built = builder.build(views)?;
    context.progress().end();
    built.ok_or(EncodeError::Interrupted { n_done: views.used.len(), n_views: views.used.len() })
}

/// Returns texts that queries are expected to be like.
fn text_bank(plan: &Plan<'_>, context: &RunContext<'_>) -> TextBank {
    let models = plan.engines.models;
    context.time("texts", || match models.text_encoder(plan.engines.session) {
        Ok(mut encoder) => TextBank::of_model(&mut *encoder),
        Err(e) => {
            tracing::warn!("{e}; codebooks are made for queries in all directions alike");
            TextBank::directions(models.dim())
        }
    })
}

/// Returns the cost of the used views.
fn views_report(views: &DoneViews<'_>, index: &ContributionIndex) -> ViewsReport {
    let record = |view: &&View| -> ViewRecord { views.records.get(&view.name).copied().unwrap_or_default() };
    let used = &views.used;
    ViewsReport {
        view: used.iter().map(|view| view.name.clone()).collect(),
        raster_width_px: used.iter().map(|view| record(view).raster_width_px).collect(),
        n_masks: index.n_masks_of_view().collect(),
        n_regions: index.n_regions_of_view().collect(),
        n_entries: index.n_entries_of_view().collect(),
        secs: used.iter().map(|view| (f64::from(record(view).secs) * 1e3).round() / 1e3).collect(),
    }
}

/// Builds the cells of a scene whose views are all done.
struct CellBuilder<'a> {
    plan: &'a Plan<'a>,
    context: &'a RunContext<'a>,
    encoder_id: Hash32,
    index: ContributionIndex,
    table: RegionTable,
    /// What errors of scores are measured by.
    score_context: ScoreMetricContext,
    /// Bytes for the contributions that a pass of the refinement or of objects holds.
    pass_bytes: u64,
    /// Bytes for the contributions that are held while cells are built.
    cells_bytes: u64,
    /// Cells whose embeddings are held at once.
    n_at_once: usize,
    /// Each view's masks in its photo.
    photos: Vec<Photo>,
    occupancy: Option<SceneOccupancy>,
}

impl<'a> CellBuilder<'a> {
    /// Opens the contributions of the used views and checks the budget against them.
    ///
    /// # Errors
    /// [`EncodeError::Contributions`], [`EncodeError::Memory`].
    fn open(
        plan: &'a Plan<'a>,
        views: &DoneViews<'_>,
        bank: TextBank,
        occupancy: Option<SceneOccupancy>,
        context: &'a RunContext<'a>,
    ) -> Result<Self, EncodeError> {
        let (models, job) = (plan.engines.models, &plan.job);
        let n_gaussians: Vec<usize> =
            plan.inputs.split.cells.iter().map(|cell| cell.gaussians.len()).collect();
        let paths: Vec<PathBuf> = views.used.iter().map(|view| job.contributions_path(&view.name)).collect();
        let (index, mut table) =
            context.time("merge", || ContributionIndex::open(&paths, models.dim(), &n_gaussians))?;
        let photo = |(view, n_masks): (&&View, usize)| -> Result<Photo, ContributionError> {
            let outlines = photos::read_outlines(&job.outlines_path(&view.name), n_masks)?;
            Ok(Photo { name: view.name.clone(), outlines })
        };
        let photos: Vec<Photo> =
            views.used.iter().zip(index.n_masks_of_view()).map(photo).collect::<Result<_, _>>()?;
        let levels = photos.iter().flat_map(|photo| &photo.outlines).map(|outline| outline.level as u8);
        table.set_levels(levels.collect());
        let mut memory = plan.memory.clone();
        memory.views_are_done();
        table.reserve(&mut memory);
        occupancy.iter().for_each(|occupancy| occupancy.reserve(&mut memory));
        index.reserve(&mut memory);
        Refinement::reserve_regions(&mut memory, &plan.settings.aggregation, table.len());
        if plan.settings.cells.objects {
            objects::reserve_contributions(&mut memory, index.n_entries());
        }
        let pass_bytes = memory.rest(index.largest_part_bytes())?;
        let cell_bytes =
            shard::largest_cell_bytes(&plan.inputs.split, models.dim()) + index.largest_part_bytes();
        // Cells come second: contributions that are not kept in memory are read six times. But what superpoints and objects
        // took is free again.
        let rest_bytes = memory.rest_of(memory::Phase::Cells);
        let spare_bytes = rest_bytes - index.budget_bytes(pass_bytes);
        let n_more = (spare_bytes / cell_bytes.max(1)).min(context.pool().current_num_threads() as u64 - 1);
        let cells_bytes = (rest_bytes - n_more * cell_bytes).min(pass_bytes);
        let score_context = context.time("texts", || {
            let metric = ScoreMetric::new(models.dim(), &bank);
            let spread = metric.spread(table.mask_vectors());
            ScoreMetricContext { metric, bank, spread }
        });
        let encoder_id = Hash32(models.encoder_id().hash());
        let n_at_once = 1 + n_more as usize;
        tracing::debug!("{n_at_once} cells at once, {cell_bytes} bytes each");
        Ok(Self {
            plan,
            context,
            encoder_id,
            index,
            table,
            score_context,
            pass_bytes,
            cells_bytes,
            n_at_once,
            photos,
            occupancy,
        })
    }

    /// Finds the objects of the scene if the settings ask for them; `None` if cancelled, too.
    fn objects(&self, superpoints: Option<&Superpoints>) -> Result<Option<SceneObjects>, EncodeError> {
        if !self.plan.settings.cells.objects {
            return Ok(None);
        }
        let scene = objects::Scene {
            index: &self.index,
            table: &self.table,
            gaussians: &self.plan.inputs.scene,
            split: &self.plan.inputs.split,
            superpoints,
            photos: &self.photos,
            score_context: &self.score_context,
            group_bytes: self.pass_bytes,
            cancel: self.context.cancel(),
        };
        Ok(self.context.time("objects", || objects::find(&scene))?)
    }

    /// Returns the size of what the views found, before refinement adds superpoints to the regions.
    fn counts(&self, views: &DoneViews<'_>) -> Counts {
        Counts {
            n_views_without_masks: self.index.n_views_without_masks(),
            n_masks: self.table.n_masks(),
            n_regions: self.table.len(),
            n_entries: self.index.n_entries(),
            views: views_report(views, &self.index),
        }
    }

    /// Finds objects, refines the contributions and builds the cells; `None` if cancelled.
    ///
    /// # Errors
    /// [`EncodeError`].
    fn build(&mut self, views: &DoneViews<'_>) -> Result<Option<BuiltCells>, EncodeError> {
        let Plan { inputs, store, settings, .. } = *self.plan;
        let mut n_entries = vec![0; inputs.split.cells.len()];
        self.index.parts().iter().for_each(|part| n_entries[part.cell_id as usize] += part.n_entries);
        let mut built = BuiltCells {
            records: Vec::new(),
            n_subspaces: Vec::new(),
            n_entries,
            extras: Extras::new(),
            n_without_evidence: 0,
            objects: None,
            occupancy: self.occupancy.as_ref().map(|occupancy| occupancy.report),
            counts: self.counts(views),
            score_sums: [0.0; 3],
        };
        let aggregation = settings.aggregation;
        let passes =
            Passes { index: &self.index, group_bytes: self.pass_bytes, cancel: self.context.cancel() };
        let subject = Subject { scene: &inputs.scene, split: &inputs.split };
        self.context.begin_phase(Phase::Superpoints);
        let begun = self.context.time("superpoints", || {
            let begin = || Refinement::begin(aggregation, passes, &mut self.table, subject, &self.photos);
            self.context.install(begin)
        })?;
        if self.context.is_cancelled() {
            return Ok(None);
        }
        // From all masks alike, whatever weight they have in the refinement.
        self.context.begin_phase(Phase::Objects);
        let superpoints = begun.as_ref().and_then(Begun::superpoints);
        let objects = self.context.install(|| self.objects(superpoints))?;
        if let Some(found) = &objects {
            self.context.progress().objects(&mut found.objects.iter().map(Object::found));
        }
        self.context.begin_phase(Phase::Refine);
        let object_of = objects.as_ref().map_or(&[][..], |objects| &objects.object_of);
        let refinement = self.context.time("refine", || {
            let finish = |begun: Begun| begun.finish(passes, &mut self.table, subject, object_of);
            self.context.install(|| begun.map_or(Ok(None), finish))
        })?;
        if self.context.is_cancelled() {
            return Ok(None);
        }
        if aggregation != Aggregation::PLAIN {
            let record = serde_json::to_vec(&aggregation).map_err(std::io::Error::from)?;
            built.extras.insert(EXTRA_AGGREGATION.into(), store.put_bytes(&record)?.0);
        }
        let regions = self.context.install(|| store.put_object(|out| self.table.write(out)))?.0;
        built.extras.insert(EXTRA_REGIONS.into(), regions);
        self.context.begin_phase(Phase::Cells);
        let has_poses = settings.cells.photo_poses;
        let photo_poses = has_poses.then(|| shard::photo_poses(&inputs.split, &views.used));
        let cells = CellsToBuild {
            plan: self.plan,
            index: &self.index,
            merged: Merged {
                table: &self.table,
                score_context: &self.score_context,
                refinement: refinement.as_ref(),
                objects: objects.as_ref(),
                occupancy: self.occupancy.as_ref(),
            },
            photo_poses: photo_poses.as_deref(),
            encoder_id: self.encoder_id,
            group_bytes: self.cells_bytes,
            n_at_once: self.n_at_once,
        };
        let Some(finished) = here::build_cells(&cells, self.context)? else { return Ok(None) };
        finished.into_iter().for_each(|cell| built.add(cell));
        built.objects = objects.map(|objects| objects.report);
        Ok(Some(built))
    }
}
