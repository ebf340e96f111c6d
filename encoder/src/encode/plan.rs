//! The first step: everything that is read, checked and decided before the first view.

use std::time::Instant;

use slag_common::{Hash32, View};
use slag_models::SessionOptions;

use super::context::RunContext;
use super::coverage::{self, Coverage};
use super::engines::Engines;
use super::error::EncodeError;
use super::expected;
use super::identity;
use super::inputs::{self, Inputs};
use super::job::{Job, job_status};
use super::kept::{self, InputsRecord, LostViews};
use super::settings::{EncodeSettings, Masks, RunSettings, ViewOrder, ViewSettings};
use super::view::ViewTools;
use crate::cells::CellSplit;
use crate::embed::SharedEncoders;
use crate::lift::refine::Refinement;
use crate::memory::{self, MemoryPlan, PlannedPeak};
use crate::objects;
use crate::raster::project::Prepared;
use crate::raster::{LoadedScene, RasterView};
use crate::segment::{
    GivenMasks, GraphSegmenter, GraphSettings, NoMasks, SamSegmenter, SegmentError, Segmenter,
};
use crate::shard;
use crate::store::Store;

/// What was decided.
pub(crate) struct Plan<'a> {
    pub(crate) settings: &'a EncodeSettings,
    pub(crate) engines: &'a Engines<'a>,
    pub(crate) inputs: &'a Inputs,
    pub(crate) store: &'a Store,
    pub(super) memory: MemoryPlan,
    /// The most memory that the run is expected to take; `None` where the system does not tell what it has now.
    pub(super) planned_peak: Option<PlannedPeak>,
    pub(crate) segmenter: Box<dyn Segmenter>,
    pub(crate) job: Job<'a>,
    pub(super) inputs_record: InputsRecord,
    /// Kept views that are done anew.
    pub(super) lost_views: Option<LostViews>,
    pub(super) scene: Box<dyn LoadedScene + 'a>,
    /// The views to use, as numbers in the order in which they are taken.
    pub(crate) order: Vec<usize>,
    pub(super) coverage: Option<Coverage>,
    pub(super) coverage_secs: f64,
}

impl Plan<'_> {
    /// Returns what every view needs on its way on this machine.
    pub(super) fn view_tools(&self) -> ViewTools<'_> {
        ViewTools {
            engines: self.engines,
            settings: &self.settings.view,
            n_threads: self.settings.run.threads,
            gpus: &self.settings.run.gpus,
            segmenter: self.segmenter.as_ref(),
            scene: self.scene.as_ref(),
            split: &self.inputs.split,
            photos: None,
            sink: &self.job,
        }
    }
}

/// Checks the budget, opens segmenter and job, loads the scene and chooses the views.
///
/// # Errors
/// [`EncodeError`].
pub(super) fn plan<'a>(
    settings: &'a EncodeSettings,
    engines: &'a Engines<'a>,
    store: &'a Store,
    inputs: &'a Inputs,
    context: &RunContext<'_>,
) -> Result<Plan<'a>, EncodeError> {
    let mut memory = memory_plan(settings, inputs, engines.models.dim());
    if let (false, Some(preprocess)) = (engines.session.is_on_cpu(), engines.models.preprocess()) {
        // A byte a channel, and one for the mask.
        let square_bytes = 4 * u64::from(preprocess.size_px()).pow(2);
        SharedEncoders::reserve(&mut memory, &settings.run.gpus, square_bytes);
    }
    memory.rest(0)?;
    if settings.output.text_model {
        // What cannot be carried is refused before the work.
        engines.models.text_side()?;
    }
    let segmenter = segmenter_of(&settings.view, &settings.run.gpus, engines)?;
    if let Some(without) = segmenter.check_views(&inputs.views, settings.run.strict)? {
        tracing::warn!("{without}");
    }
    let ids = context.time("identity", || {
        context.install(|| identity::identities(settings, engines, segmenter.as_ref(), inputs))
    })?;
    let id_of_view = inputs.views.iter().map(|view| view.name.clone()).zip(ids.of_view).collect();
    let lost_views = lost_views(store, ids.of_scene, &ids.inputs, inputs, context)?;
    let job = Job::open(store, ids.of_scene, id_of_view, settings.run.restart)?;
    let scene = context.time("raster", || context.install(|| engines.rasterizer.load(&inputs.scene)))?;
    let start = Instant::now();
    let (order, coverage) =
        context.install(|| choose_views(&settings.run, scene.as_ref(), inputs, context))?;
    let coverage_secs = coverage.as_ref().map_or(0.0, |_| start.elapsed().as_secs_f64());
    let views: Vec<&View> = order.iter().map(|i| &inputs.views[*i]).collect();
    let of_models = (engines.models.image_bytes(), engines.models.dim());
    let of_scene = (scene.as_ref(), &views[..]);
    context.install(|| expected::reserve(&mut memory, settings, inputs, of_scene, of_models));
    memory::give_back();
    let planned_peak = memory::held_bytes().map(|held_bytes| memory.planned_peak(held_bytes));
    if let Some(PlannedPeak { len_bytes, phase }) = planned_peak {
        tracing::info!("at most about {} MB of memory, in {phase:?}", len_bytes / 1_000_000);
    }
    Ok(Plan {
        settings,
        engines,
        inputs,
        store,
        memory,
        planned_peak,
        segmenter,
        job,
        inputs_record: ids.inputs,
        lost_views,
        scene,
        order,
        coverage,
        coverage_secs,
    })
}

/// Returns which kept views cannot be taken over, and says so; an encode that is unfinished is refused later, not replaced.
fn lost_views(
    store: &Store,
    of_scene: Hash32,
    record: &InputsRecord,
    inputs: &Inputs,
    context: &RunContext<'_>,
) -> Result<Option<LostViews>, EncodeError> {
    let kept = job_status(store.db(), store.dir())?.filter(|status| status.n_views > 0);
    let Some(kept) = kept.filter(|status| status.is_published) else { return Ok(None) };
    if Job::is_kept(store, of_scene)? {
        return Ok(None);
    }
    let job = store.job_dir()?;
    let lost = context.install(|| kept::lost(&job, kept.n_views, record, &inputs.scene));
    tracing::warn!("{}", lost.reason);
    Ok(Some(lost))
}

/// Reserves what is known before the first view; what depends on masks and contributions is reserved once the views
/// are done.
fn memory_plan(settings: &EncodeSettings, inputs: &Inputs, dim: usize) -> MemoryPlan {
    let n_gaussians = inputs.scene.len();
    let mut memory = MemoryPlan::new(settings.run.memory_bytes);
    inputs::reserve(&mut memory, &inputs.scene);
    CellSplit::reserve(&mut memory, n_gaussians);
    Prepared::reserve(&mut memory, n_gaussians);
    inputs::reserve_photos(&mut memory, &inputs.views, settings.run.threads);
    shard::reserve(&mut memory, &inputs.split, dim);
    Refinement::reserve(&mut memory, &settings.aggregation, n_gaussians);
    if settings.cells.objects {
        objects::reserve(&mut memory, n_gaussians, settings.aggregation.has_fine_superpoints());
    }
    memory
}

/// Opens the segmenter of some settings, on some GPUs.
///
/// # Errors
/// [`EncodeError::NoPatches`], [`EncodeError::Segment`].
pub(crate) fn segmenter_of(
    settings: &ViewSettings,
    gpus: &[u32],
    engines: &Engines<'_>,
) -> Result<Box<dyn Segmenter>, EncodeError> {
    if settings.regions.have_masks() {
        open_segmenter(&settings.masks, engines.session, gpus)
    } else if engines.models.patches_per_side().is_some() {
        Ok(Box::new(NoMasks))
    } else {
        Err(EncodeError::NoPatches { model: engines.models.encoder_id().to_string() })
    }
}

fn open_segmenter(
    masks: &Masks,
    session: &SessionOptions,
    gpus: &[u32],
) -> Result<Box<dyn Segmenter>, EncodeError> {
    Ok(match masks {
        Masks::Auto { n_levels } => {
            let settings = GraphSettings::learnt(*n_levels);
            Box::new(GraphSegmenter::learnt(settings, session, gpus).map_err(SegmentError::from)?)
        }
        Masks::Graph => Box::new(GraphSegmenter::default()),
        Masks::Given { dir, ignore_ids } => Box::new(GivenMasks::open(dir, ignore_ids.clone())?),
        Masks::Sam { dir, settings, n_model_threads } => {
            let session = SessionOptions { intra_op_threads: *n_model_threads, ..session.clone() };
            Box::new(SamSegmenter::open(dir, settings.clone(), &session, gpus)?)
        }
    })
}

/// Returns the views to use, as numbers in the order in which they are taken.
fn choose_views(
    run: &RunSettings,
    scene: &dyn LoadedScene,
    inputs: &Inputs,
    context: &RunContext<'_>,
) -> Result<(Vec<usize>, Option<Coverage>), EncodeError> {
    let views = &inputs.views;
    let n = views.len();
    let limit = run.views_limit.of(n);
    let spread = |limit: usize| (0..limit).map(|i| i * n / limit).collect::<Vec<_>>();
    Ok(match run.view_order {
        ViewOrder::Names => ((0..limit).collect(), None),
        // With a budget every beginning must be spread, with a limit the whole.
        ViewOrder::Nth if run.time_budget.is_some() => {
            let chosen = spread(limit);
            (coverage::spread_order(limit).into_iter().map(|i| chosen[i]).collect(), None)
        }
        ViewOrder::Nth => (spread(limit), None),
        ViewOrder::Coverage => {
            let raster_view =
                |v: &View| RasterView { camera_from_world: v.camera_from_world, intrinsics: v.intrinsics };
            let raster_views: Vec<RasterView> = views.iter().map(raster_view).collect();
            let measured = Coverage::measure(scene, inputs.scene.len(), &raster_views, context.cancel());
            let coverage = measured
                .map_err(|(view, source)| EncodeError::Raster { view: views[view].name.clone(), source })?
                .ok_or(EncodeError::Interrupted { n_done: 0, n_views: limit })?;
            let mut order = coverage.order();
            order.truncate(limit);
            (order, Some(coverage))
        }
    })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use slag_common::{Distortion, Gaussians, Intrinsics};

    /// Superpoints take more than 204 bytes a Gaussian, once all views are done: a budget below that is refused before.
    #[test]
    fn what_refinement_takes_is_refused_before_the_first_view() {
        let mut settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        settings.run.memory_bytes = 100_000 * 204;
        let scene = Gaussians { means_in_world: vec![glam::DVec3::ZERO; 100_000], ..Gaussians::default() };
        let split = CellSplit::default();
        let inputs = Inputs { scene, split, views: Vec::new(), missing: Vec::new(), geo_reference: None };
        let refused =
            memory_plan(&settings, &inputs, 512).rest(0).expect_err("the objects' lists come on top");
        assert!(refused.is_before_views && refused.parts[0].purpose.contains("superpoints"), "{refused}");
        settings.run.memory_bytes *= 2;
        memory_plan(&settings, &inputs, 512).rest(0).expect("fits");
    }

    /// By hand: two threads hold a photo of 400 x 300 pixels, whose file is absent, and one of 40 x 30, which its header
    /// says, of the same camera; 15 bytes a pixel.
    #[test]
    fn photos_in_work_are_reserved_by_their_files() {
        let folder = tempfile::tempdir().expect("a folder");
        let view = |name: &str| View {
            name: name.into(),
            image_path: folder.path().join(name),
            intrinsics: Intrinsics {
                width_px: 400,
                height_px: 300,
                focal_x_px: 300.0,
                focal_y_px: 300.0,
                centre_x_px: 200.0,
                centre_y_px: 150.0,
                distortion: Distortion::None,
            },
            camera_from_world: glam::DAffine3::IDENTITY,
        };
        for name in ["a.png", "c.png"] {
            image::RgbImage::new(40, 30).save(folder.path().join(name)).expect("it is writable");
        }
        let mut memory = MemoryPlan::new(0);
        inputs::reserve_photos(&mut memory, &["a.png", "b.png", "c.png"].map(view), 2);
        let refused = memory.rest(0).expect_err("nothing fits");
        assert_eq!(refused.needed_bytes, 15 * (400 * 300 + 40 * 30));
    }
}
