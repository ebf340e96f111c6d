//! The pipeline: photos, poses and a splat in, a published generation of shards out.
//!
//! Views are independent: each leaves one file of contributions in the job's folder, so a killed encode
//! resumes after the last finished view. Everything after that reads those files in the order of
//! the views' names, so the store's bytes do not depend on threads, on the order of views or on where
//! a run was interrupted.

mod cells;
pub mod coverage;
mod job;
mod pipeline;
mod settings;
mod view;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{OnceLock, PoisonError};
use std::time::Instant;

use serde::Serialize;
use slag_common::manifest::{self, Calibration, CellRecord, EncoderRecord, Manifest};
use slag_common::poses::{self, PoseError};
use slag_common::shard::ScoreErrors;
use slag_common::splat::{self, SplatError};
use slag_common::{Hash32, View};
use slag_models::{ModelDir, ModelError, SessionOptions};

use crate::codebook::TextBank;
use crate::embed::EmbedError;
use crate::ingest::{self, GeoError, IngestError};
use crate::lift::{ContributionError, ContributionIndex};
use crate::objects::ObjectsReport;
use crate::progress::Progress;
use crate::raster::{LoadedScene, RasterError, RasterView, Rasterizer};
use crate::segment::noise::NoisyMasks;
use crate::segment::{GivenMasks, GraphSegmenter, GraphSettings, SamSegmenter, SegmentError, Segmenter};

use crate::store::{Store, StoreError};
use cells::CellBuilder;
use coverage::{Coverage, CoverageReport};
use job::{Job, ViewRecord};
pub use pipeline::StageReport;
pub use settings::{DEFAULT_MASK_LEVELS, EncodeSettings, Masks, RasterWidth, ViewOrder, ViewsLimit};
use view::{ViewStages, Work};

/// Why an encode ended without a new generation.
#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    /// The scene cannot be read.
    #[error(transparent)]
    Splat(#[from] SplatError),
    /// The poses cannot be read.
    #[error(transparent)]
    Poses(#[from] PoseError),
    /// The geo-reference cannot be read.
    #[error(transparent)]
    Geo(#[from] GeoError),
    /// A photo cannot be read, and `strict` is set.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// Masks cannot be made or read.
    #[error(transparent)]
    Segment(#[from] SegmentError),
    /// The scene cannot be rasterised.
    #[error(transparent)]
    Scene(#[from] RasterError),
    /// A view cannot be rasterised.
    #[error("view {view}: {source}")]
    Raster {
        /// The view.
        view: String,
        /// Why.
        source: RasterError,
    },
    /// A model cannot be opened.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A model failed on a view's crops.
    #[error("view {view}: {source}")]
    Embed {
        /// The view.
        view: String,
        /// Why.
        source: EmbedError,
    },
    /// The store said no.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A file of contributions is damaged.
    #[error(transparent)]
    Sums(#[from] ContributionError),
    /// A working file could not be read or written.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// Job records.
    #[error("{}: job records: {source}; run with --restart to begin anew", path.display())]
    Records {
        /// The store.
        path: PathBuf,
        /// What sled says.
        source: sled::Error,
    },
    /// The unfinished job in the store is another one.
    #[error(
        "{}: an unfinished encode of other inputs or settings lies here ({n_done} views done); finish it with the \
         settings it was started with, or drop it with --restart", path.display()
    )]
    OtherJob {
        /// The store.
        path: PathBuf,
        /// Views that it finished.
        n_done: usize,
    },
    /// Photos are missing, and `strict` is set.
    #[error("{n_missing} of {n_views} photos are missing, the first is {}; give their folder with --images", first.display())]
    MissingImages {
        /// How many.
        n_missing: usize,
        /// Of how many.
        n_views: usize,
        /// The first of them.
        first: PathBuf,
    },
    /// No view is left.
    #[error("none of {n_views} views could be used ({reason}); give the photos' folder with --images")]
    NoViews {
        /// Views in the poses file.
        n_views: usize,
        /// The first reason.
        reason: String,
    },
    /// The scene has no usable Gaussian.
    #[error("{}: none of {n_gaussians} Gaussians is usable (finite, positive, a rotation); export the splat again", path.display())]
    NoGaussians {
        /// The splat file.
        path: PathBuf,
        /// Gaussians in it.
        n_gaussians: usize,
    },
    /// The budget is too small.
    #[error(
        "--memory is {available_bytes} bytes, {needed_bytes} are needed: {cell_bytes} for the largest cell, \
         {index_bytes} for the masks and contributions of all views; raise --memory or lower --cell-gaussians"
    )]
    Memory {
        /// Bytes there are.
        available_bytes: u64,
        /// Bytes needed at least.
        needed_bytes: u64,
        /// Of these, to build the largest cell.
        cell_bytes: u64,
        /// Of these, for mask vectors and where contributions lie.
        index_bytes: u64,
    },
    /// Stopped by the user; a rerun resumes.
    #[error("interrupted after {n_done} of {n_views} views; run the same command again to resume")]
    Interrupted {
        /// Views finished.
        n_done: usize,
        /// Views in all.
        n_views: usize,
    },
}

impl EncodeError {
    /// Returns whether an input of one view is at fault, so that the others may go on.
    fn is_of_one_view(&self) -> bool {
        match self {
            Self::Ingest(_) => true,
            Self::Segment(error) => !matches!(error, SegmentError::Model(_)),
            _ => false,
        }
    }
}

/// A view that was left out.
#[derive(Clone, Debug, Serialize)]
pub struct SkippedView {
    /// Its name.
    pub view: String,
    /// Why.
    pub reason: String,
}

/// What a cell was given: rows go by its content, bytes by rows and Gaussians.
#[derive(Clone, Debug, Serialize)]
pub struct CellReport {
    /// The cell.
    pub cell_id: u32,
    /// Gaussians.
    pub n_gaussians: u32,
    /// Sums per (Gaussian, region).
    pub n_entries: u64,
    /// Codebook rows.
    pub n_centroids: u32,
    /// Half bytes a Gaussian of the residual code; 0 where rows are enough for every profile.
    pub n_subspaces: u32,
    /// Bytes of its shards by profile.
    pub shard_bytes: BTreeMap<String, u64>,
    /// Mean error of their scores, relative to the spread of scores.
    pub score_error: BTreeMap<String, f32>,
}

/// What each view was given, a column a figure, in the order of the names.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ViewsReport {
    /// Names.
    pub view: Vec<String>,
    /// Width at which weights were rasterised.
    pub raster_width_px: Vec<u32>,
    /// Masks.
    pub n_masks: Vec<usize>,
    /// Regions.
    pub n_regions: Vec<usize>,
    /// Sums per (Gaussian, region).
    pub n_entries: Vec<u64>,
    /// Seconds of all stages but the last, to the millisecond.
    pub secs: Vec<f64>,
}

/// What an encode did.
#[derive(Clone, Debug, Serialize)]
pub struct EncodeSummary {
    /// The generation that was published.
    pub generation: u64,
    /// Gaussians in cells.
    pub n_gaussians: u64,
    /// Those without an embedding.
    pub n_without_evidence: u64,
    /// Unusable Gaussians, in no cell.
    pub n_rejected: u64,
    /// Views that were used.
    pub n_views: usize,
    /// Views that there are photos of.
    pub n_views_with_photo: usize,
    /// The order in which they were taken.
    pub view_order: ViewOrder,
    /// What the used views show of what all show, where views were taken by it.
    pub coverage: Option<CoverageReport>,
    /// Seconds of the raster of all views that it took.
    pub coverage_secs: f64,
    /// Of these, finished by an earlier, interrupted run.
    pub n_views_resumed: usize,
    /// Views without any mask: no mask file, or none large enough.
    pub n_views_without_masks: usize,
    /// Views that were left out, and why.
    pub skipped_views: Vec<SkippedView>,
    /// Masks embedded.
    pub n_masks: usize,
    /// Regions in all views.
    pub n_regions: usize,
    /// Sums per (Gaussian, region).
    pub n_entries: u64,
    /// Cells.
    pub n_cells: usize,
    /// Codebook rows in all cells.
    pub n_centroids: u64,
    /// Objects, where they were looked for.
    pub objects: Option<ObjectsReport>,
    /// Bytes of all shards by profile.
    pub shard_bytes: BTreeMap<String, u64>,
    /// What was spent on each cell.
    pub cells: Vec<CellReport>,
    /// What was spent on each view.
    pub views: ViewsReport,
    /// Seconds spent in each stage, added over threads.
    pub busy_secs: BTreeMap<String, f64>,
    /// How busy the stages of the views were, in their order.
    pub view_stages: Vec<StageReport>,
    /// Seconds from the first view to the last.
    pub views_secs: f64,
    /// Seconds from start to end.
    pub wall_secs: f64,
    /// What the image model really ran on; absent where no view was left to do, or no runtime is needed.
    pub images_on: Option<String>,
    /// The encoder's name.
    pub encoder: String,
}

/// Adds up the time spent in each stage, over all threads.
#[derive(Default)]
pub(crate) struct StageTimes(Mutex<BTreeMap<&'static str, f64>>);

impl StageTimes {
    pub(crate) fn time<T>(&self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        let seconds = start.elapsed().as_secs_f64();
        *self.0.lock().unwrap_or_else(|e| e.into_inner()).entry(stage).or_default() += seconds;
        result
    }
}

/// Encodes a scene into a store and publishes the result as its next generation.
///
/// # Errors
/// [`EncodeError`]; the store keeps its current generation, and finished views are not done again.
pub fn encode(
    settings: &EncodeSettings,
    models: &ModelDir,
    session: &SessionOptions,
    rasterizer: &dyn Rasterizer,
    progress: &dyn Progress,
    cancel: &AtomicBool,
) -> Result<EncodeSummary, EncodeError> {
    let start = Instant::now();
    let times = StageTimes::default();
    // First of all, so that a second encode into the same store fails at once.
    let store = Store::create_or_open(&settings.store)?;
    let geo_reference = settings.geo.as_deref().map(ingest::read_geo_reference).transpose()?;
    let read_options = splat::ReadOptions { with_sh_rest: false };
    let scene = times.time("read", || splat::read(&settings.scene, &read_options))?;
    let (views, mut skipped) = find_views(settings)?;
    let split = times.time("cells", || crate::cells::split(&scene, settings.cells));
    if split.cells.is_empty() {
        let n_gaussians = scene.len();
        return Err(EncodeError::NoGaussians { path: settings.scene.clone(), n_gaussians });
    }
    // Before hours of work: the part of the budget that is known now.
    cells::check_memory(settings.memory_bytes, cells::largest_cell_bytes(&split, models.dim()), 0, 0)?;
    let segmenter: Box<dyn Segmenter> = match &settings.masks {
        Masks::Auto { n_levels } => {
            let settings = GraphSettings::learnt(*n_levels);
            Box::new(GraphSegmenter::learnt(settings, session).map_err(SegmentError::from)?)
        }
        Masks::Graph => Box::new(GraphSegmenter::default()),
        Masks::Given { dir, ignore_ids } => Box::new(GivenMasks::open(dir, ignore_ids.clone())?),
        Masks::Sam { dir, settings, n_model_threads } => {
            let session = SessionOptions { intra_op_threads: *n_model_threads, ..session.clone() };
            Box::new(SamSegmenter::open(dir, settings.clone(), &session)?)
        }
    };
    let segmenter = match settings.mask_noise {
        Some(noise) => Box::new(NoisyMasks::new(segmenter, noise)),
        None => segmenter,
    };
    let fingerprint = settings.fingerprint(models, segmenter.name(), &scene, &views)?;
    let job = Job::open(&store, fingerprint, settings.restart)?;

    let done = job.done_views()?;
    let loaded = times.time("raster", || rasterizer.load(&scene))?;
    let coverage_start = Instant::now();
    let (chosen, coverage) = choose_views(settings, loaded.as_ref(), scene.len(), &views, cancel)?;
    let coverage_secs = coverage.as_ref().map_or(0.0, |_| coverage_start.elapsed().as_secs_f64());
    let n_resumed = chosen.iter().filter(|view| done.contains_key(&views[**view].name)).count();
    let stages = ViewStages {
        settings,
        scene: loaded.as_ref(),
        split: &split,
        segmenter: segmenter.as_ref(),
        models,
        session,
        images_on: OnceLock::new(),
        job: &job,
        progress,
        preprocess: models.preprocess(),
        encoders: Mutex::default(),
    };
    progress.begin("views", "view", chosen.len() as u64, n_resumed as u64);
    let views_start = Instant::now();
    let deadline = settings.time_budget.and_then(|budget| start.checked_add(budget));
    let in_order: Vec<&View> = chosen.iter().map(|view| &views[*view]).collect();
    let (view_stages, left_out) = run_views(&stages, &in_order, deadline, cancel)?;
    let views_secs = views_start.elapsed().as_secs_f64();
    let n_failed = left_out.len();
    skipped.extend(left_out);
    progress.end();
    skipped.sort_by(|a, b| a.view.cmp(&b.view));
    // In the order of names, whatever the order of the work.
    let done = job.done_views()?;
    let mut used: Vec<usize> =
        chosen.into_iter().filter(|view| done.contains_key(&views[*view].name)).collect();
    used.sort_unstable();
    let coverage = coverage.map(|coverage| coverage.report(used.iter().copied()));
    let used: Vec<&View> = used.into_iter().map(|view| &views[view]).collect();
    if let (true, Some(first)) = (used.is_empty(), skipped.first()) {
        return Err(EncodeError::NoViews { n_views: skipped.len(), reason: first.reason.clone() });
    }

    let bank = times.time("texts", || match models.text_encoder(session) {
        Ok(mut encoder) => TextBank::of_model(&mut *encoder),
        Err(e) => {
            tracing::warn!("{e}; codebooks take texts in all directions alike");
            TextBank::directions(models.dim())
        }
    });
    let mut builder = {
        let views = (&job, &used[..]);
        CellBuilder::open(settings, &store, &scene, &split, views, (models, bank), &times)?
    };
    let mut summary = EncodeSummary {
        generation: store.next_generation()?,
        n_gaussians: (scene.len() - split.n_rejected) as u64,
        n_without_evidence: 0,
        n_rejected: split.n_rejected as u64,
        n_views: used.len(),
        n_views_with_photo: views.len(),
        view_order: settings.view_order,
        coverage,
        coverage_secs,
        n_views_resumed: n_resumed,
        n_views_without_masks: builder.n_views_without_masks(),
        skipped_views: skipped,
        n_masks: builder.n_masks(),
        n_regions: builder.n_regions(),
        n_entries: builder.n_entries(),
        n_cells: split.cells.len(),
        n_centroids: 0,
        objects: None,
        shard_bytes: BTreeMap::new(),
        cells: Vec::new(),
        views: views_report(&used, &done, builder.index()),
        busy_secs: BTreeMap::new(),
        view_stages,
        views_secs,
        wall_secs: 0.0,
        encoder: models.encoder_id().to_string(),
        images_on: stages.images_on.get().cloned().flatten(),
    };
    progress.begin("cells", "cell", split.cells.len() as u64, 0);
    let Some(built) = builder.build(progress, cancel)? else {
        return Err(EncodeError::Interrupted { n_done: used.len(), n_views: used.len() });
    };
    progress.end();
    let mut n_entries_of_cell = vec![0; split.cells.len()];
    builder
        .index()
        .parts()
        .iter()
        .for_each(|part| n_entries_of_cell[part.cell_id as usize] += part.n_entries);
    for record in &built.records {
        let shard_bytes = record.shards.iter().map(|(profile, shard)| (profile.to_string(), shard.len_bytes));
        let shard_bytes: BTreeMap<String, u64> = shard_bytes.collect();
        for (profile, len_bytes) in &shard_bytes {
            *summary.shard_bytes.entry(profile.clone()).or_default() += len_bytes;
        }
        let n_centroids = record.shards.values().map(|shard| shard.n_centroids).max().unwrap_or(0);
        summary.n_centroids += u64::from(n_centroids);
        let CellRecord { cell_id, n_gaussians, .. } = *record;
        let relative = |errors: &ScoreErrors| errors.mean / errors.spread.max(f32::MIN_POSITIVE);
        summary.cells.push(CellReport {
            cell_id,
            n_gaussians,
            n_entries: n_entries_of_cell[cell_id as usize],
            n_centroids,
            n_subspaces: built.n_subspaces[cell_id as usize],
            shard_bytes,
            score_error: (record.shards.iter())
                .map(|(profile, shard)| (profile.to_string(), relative(&shard.score_errors)))
                .collect(),
        });
    }
    summary.n_without_evidence = built.n_without_evidence;
    summary.objects = built.objects.clone();

    let manifest = Manifest {
        version: manifest::VERSION,
        scene: settings.scene_name.clone(),
        generation: summary.generation,
        created_unix_secs: settings.created_unix_secs,
        expires_unix_secs: settings.expires_unix_secs,
        // The store says it.
        next_key: None,
        metric: settings.metric || geo_reference.is_some(),
        geo_reference,
        encoder: EncoderRecord {
            name: models.encoder_id().name.clone(),
            id: Hash32(models.encoder_id().hash()),
            dim: models.dim() as u32,
            // Three spreads above the mean, as robots reckon it.
            default_threshold: models.threshold().unwrap_or_else(|| {
                let Calibration { score_mean, score_spread } = built.calibration();
                (score_mean + 3.0 * score_spread).clamp(-1.0, 1.0)
            }),
            calibration: models.threshold().is_none().then(|| built.calibration()),
        },
        n_gaussians: summary.n_gaussians,
        n_without_evidence: summary.n_without_evidence,
        n_rejected: summary.n_rejected,
        cells: built.records,
    };
    store.publish(&manifest, &built.extras)?;
    // With views left to do the contributions stay: the next encode goes on from them.
    match settings.keep_views || done.len() + n_failed < views.len() {
        true => job.keep_published()?,
        false => job.finish()?,
    }
    store.prune()?;
    summary.busy_secs = times
        .0
        .into_inner()
        .unwrap_or_else(PoisonError::into_inner)
        .into_iter()
        .map(|(k, v)| (k.to_owned(), v))
        .collect();
    for stage in &summary.view_stages {
        *summary.busy_secs.entry(stage.stage.clone()).or_default() += stage.busy_secs;
    }
    summary.wall_secs = start.elapsed().as_secs_f64();
    Ok(summary)
}

/// Reads the poses and leaves out views without a photo. Both lists are in the order of names.
fn find_views(settings: &EncodeSettings) -> Result<(Vec<View>, Vec<SkippedView>), EncodeError> {
    let views = poses::read(&settings.views, settings.images.as_deref())?.views;
    let missing: Vec<String> = ingest::missing_images(&views).into_iter().map(|v| v.name.clone()).collect();
    if let (true, Some(first)) = (settings.strict, ingest::missing_images(&views).first()) {
        let first = first.image_path.clone();
        return Err(EncodeError::MissingImages { n_missing: missing.len(), n_views: views.len(), first });
    }
    let n_views = views.len();
    let (there, gone): (Vec<View>, Vec<View>) = views.into_iter().partition(|v| !missing.contains(&v.name));
    let skipped: Vec<SkippedView> = gone
        .into_iter()
        .map(|v| SkippedView { reason: format!("{}: no such photo", v.image_path.display()), view: v.name })
        .collect();
    if there.is_empty() {
        let reason = skipped.first().map_or("there are none".into(), |s| s.reason.clone());
        return Err(EncodeError::NoViews { n_views, reason });
    }
    Ok((there, skipped))
}

/// Returns the views to use, as numbers in the order in which they are to be taken.
fn choose_views(
    settings: &EncodeSettings,
    scene: &dyn LoadedScene,
    n_gaussians: usize,
    views: &[View],
    cancel: &AtomicBool,
) -> Result<(Vec<usize>, Option<Coverage>), EncodeError> {
    let n = views.len();
    let limit = settings.views_limit.of(n);
    let spread = |limit: usize| (0..limit).map(|i| i * n / limit).collect::<Vec<_>>();
    Ok(match settings.view_order {
        ViewOrder::Names => ((0..limit).collect(), None),
        // With a budget every beginning must be spread, with a limit the whole.
        ViewOrder::Nth if settings.time_budget.is_some() => {
            let chosen = spread(limit);
            (coverage::spread_order(limit).into_iter().map(|i| chosen[i]).collect(), None)
        }
        ViewOrder::Nth => (spread(limit), None),
        ViewOrder::Coverage => {
            let raster_view =
                |v: &View| RasterView { camera_from_world: v.camera_from_world, intrinsics: v.intrinsics };
            let raster_views: Vec<RasterView> = views.iter().map(raster_view).collect();
            let measured = Coverage::measure(scene, n_gaussians, &raster_views, cancel);
            let coverage = measured
                .map_err(|(view, source)| EncodeError::Raster { view: views[view].name.clone(), source })?
                .ok_or(EncodeError::Interrupted { n_done: 0, n_views: limit })?;
            let mut order = coverage.order();
            order.truncate(limit);
            (order, Some(coverage))
        }
    })
}

/// Returns what was spent on the views that are used.
fn views_report(
    used: &[&View],
    done: &BTreeMap<String, ViewRecord>,
    index: &ContributionIndex,
) -> ViewsReport {
    let record = |view: &&View| done.get(&view.name).copied().unwrap_or_default();
    ViewsReport {
        view: used.iter().map(|view| view.name.clone()).collect(),
        raster_width_px: used.iter().map(|view| record(view).raster_width_px).collect(),
        n_masks: index.n_masks_of_view().collect(),
        n_regions: index.n_regions_of_view().collect(),
        n_entries: index.n_entries_of_view().collect(),
        secs: used.iter().map(|view| (f64::from(record(view).secs) * 1e3).round() / 1e3).collect(),
    }
}

/// Works off the views that are not done yet, none begun after `deadline` but a first one. Returns how busy the
/// stages were, and the views that were left out.
fn run_views(
    stages: &ViewStages<'_>,
    views: &[&View],
    deadline: Option<Instant>,
    cancel: &AtomicBool,
) -> Result<(Vec<StageReport>, Vec<SkippedView>), EncodeError> {
    let done = stages.job.done_views()?;
    let mut has_some = views.iter().any(|view| done.contains_key(&view.name));
    let open = views.iter().copied().filter(|view| !done.contains_key(&view.name));
    // No view is begun once the user has said stop or the time is over; those at hand are finished.
    let may_begin = move |_: &&View| {
        let in_time = deadline.is_none_or(|deadline| Instant::now() < deadline);
        !cancel.load(Ordering::Relaxed) && (in_time || !std::mem::replace(&mut has_some, true))
    };
    let source = open.take_while(may_begin).map(Work::begin);
    let skipped = Mutex::new(Vec::new());
    let reports = pipeline::run(&stages.stages(), stages.settings.threads.max(1), source, |_, work| {
        let view = work.view();
        match stages.step(work) {
            // One bad photo or mask file of a thousand must not end an encode; a model that fails on one view is
            // no model for the others.
            Err(error) if !stages.settings.strict && error.is_of_one_view() => {
                tracing::warn!("view {} is left out: {error}", view.name);
                let skip = SkippedView { view: view.name.clone(), reason: error.to_string() };
                skipped.lock().unwrap_or_else(PoisonError::into_inner).push(skip);
                Ok(None)
            }
            result => result,
        }
    })?;
    if cancel.load(Ordering::Relaxed) {
        let n_done = stages.job.done_views()?.len();
        return Err(EncodeError::Interrupted { n_done, n_views: views.len() });
    }
    Ok((reports, skipped.into_inner().unwrap_or_else(PoisonError::into_inner)))
}
