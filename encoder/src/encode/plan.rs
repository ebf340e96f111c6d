//! The first step: everything that is read, checked and decided before the first view.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use slag_common::shard::{Profile, ShardHeader};
use slag_common::{Hash32, occupancy};
use slag_models::SessionOptions;

use super::context::{Engines, RunContext};
use super::coverage::{self, Coverage};
use super::error::EncodeError;
use super::inputs::{self, Inputs};
use super::job::{Job, JobStatus, job_status};
use super::report::{LostViews, are_unlike};
use super::settings::{EncodeSettings, Masks, RunSettings, ViewOrder, ViewSettings};
use super::view::ViewTools;
use crate::cells::CellSplit;
use crate::ground::{self, Standing};
use crate::lift::refine::Refinement;
use crate::memory::MemoryPlan;
use crate::raster::{self, LoadedScene, RasterView};
use crate::segment::{
    GivenMasks, GraphSegmenter, GraphSettings, NoMasks, SamSegmenter, SegmentError, Segmenter, WithStanding,
};
use crate::store::{Store, StoreReader};
use crate::{check, ingest, landmarks, objects, shard};

/// Number of views whose drawings are compared with their photos.
const N_COMPARED: usize = 4;

pub(crate) struct Plan<'a> {
    pub(crate) context: &'a RunContext<'a>,
    pub(crate) settings: &'a EncodeSettings,
    pub(crate) engines: &'a Engines<'a>,
    pub(crate) inputs: &'a Inputs,
    pub(crate) store: &'a Store,
    pub(super) memory: MemoryPlan,
    pub(crate) segmenter: Box<dyn Segmenter>,
    pub(crate) job: Job,
    pub(super) lost_views: Option<LostViews>,
    /// Encoder of the replaced generation, if it is another.
    pub(super) encoder_before: Option<String>,
    /// Of the compared views those that look less like their photo than a plain colour does, and all.
    pub(super) n_unlike: [usize; 2],
    pub(super) scene: Box<dyn LoadedScene + 'a>,
    /// Indices of the views to use, in order.
    pub(crate) order: Vec<usize>,
    pub(super) coverage: Option<Coverage>,
    pub(super) coverage_secs: f64,
}

impl Plan<'_> {
    pub(super) fn view_tools(&self) -> ViewTools<'_> {
        ViewTools {
            context: self.context,
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
pub(super) fn plan<'a>(
    settings: &'a EncodeSettings,
    engines: &'a Engines<'a>,
    store: &'a Store,
    inputs: &'a Inputs,
    rasterizer: &str,
    context: &'a RunContext<'a>,
) -> Result<Plan<'a>, EncodeError> {
    let memory = memory_plan(settings, inputs, engines);
    memory.rest(0)?;
    if settings.output.text_model {
        // Refused before any work.
        engines.models.text_side()?;
    }
    let segmenter = segmenter_of(&settings.view, &settings.run.gpus, engines, &inputs.standing)?;
    if let Some(without) = segmenter.check_views(&inputs.views, settings.run.strict)? {
        tracing::warn!("{without}");
    }
    let (of_scene, id_of_view) = context.time("identity", || {
        let of = || inputs::identities(settings, engines, segmenter.as_ref(), rasterizer, inputs);
        context.install(of)
    })?;
    let lost_views = lost_views(store, of_scene)?;
    let job = Job::open(store, of_scene, id_of_view, settings.run.restart)?;
    let scene = context.time("raster", || context.install(|| engines.rasterizer.load(&inputs.scene)))?;
    let is_drawn_now = settings.inputs.planned.is_some();
    let n_unlike = if is_drawn_now { [0; 2] } else { context.install(|| unlike(inputs, scene.as_ref())) };
    let start = Instant::now();
    let (order, coverage) =
        context.install(|| choose_views(&settings.run, scene.as_ref(), inputs, context))?;
    let coverage_secs = coverage.as_ref().map_or(0.0, |_| start.elapsed().as_secs_f64());
    let plan = Plan {
        context,
        settings,
        engines,
        inputs,
        store,
        memory,
        segmenter,
        job,
        lost_views,
        encoder_before: encoder_before(settings, inputs, engines),
        n_unlike,
        scene,
        order,
        coverage,
        coverage_secs,
    };
    let mut memory = plan.memory.clone();
    plan.view_tools().reserve(&mut memory, &inputs.views);
    memory.rest(0)?;
    Ok(Plan { memory, ..plan })
}

/// Warns of what robots lose by this encode. Returns the encoder of the store's generation, if this encode publishes
/// another's vectors: robots refuse them until they have its text model.
fn encoder_before(settings: &EncodeSettings, inputs: &Inputs, engines: &Engines<'_>) -> Option<String> {
    // Without a generation, or with a damaged one, there is nothing to report.
    let reader = StoreReader::open(&settings.output.store).ok()?;
    let lost = lost(&reader, settings, inputs);
    if !lost.is_empty() {
        tracing::warn!(
            "{}: its generation {} has {}; this encode has not, and robots that use that fail after their next fetch",
            settings.output.store.display(),
            reader.manifest().generation,
            lost.join(", ")
        );
    }
    let (before, now) = (&reader.manifest().encoder, engines.models.encoder_id());
    if before.id == Hash32(now.hash()) {
        return None;
    }
    let name = settings.output.models.as_deref().unwrap_or(Path::new("the embedded ones"));
    let then = match settings.output.text_model {
        true => "robots fetch its text model with the scene".to_owned(),
        false => format!(
            "robots refuse the new generation until they are started with --models {}; encode with --text-model, and they fetch it",
            name.display()
        ),
    };
    tracing::warn!(
        "{}: published with {:?}, this encode is by {now}: {then}",
        settings.output.store.display(),
        before.name
    );
    Some(before.name.clone())
}

/// What a generation has and the next will not, with the flag that keeps it.
fn lost(reader: &StoreReader, settings: &EncodeSettings, inputs: &Inputs) -> Vec<String> {
    let before = reader.manifest();
    let head = before.cells.iter().find_map(|cell| reader.shard_head(cell)).unwrap_or_default();
    let has = |section| ShardHeader::has_section(&head, section);
    let is_geographic = inputs.geo_reference.is_some();
    let has_no = |profile: &&Profile| !settings.cells.shards.profiles.contains(profile);
    let profiles: BTreeSet<&Profile> = before.cells.iter().flat_map(|cell| cell.shards.keys()).collect();
    let shards = profiles.into_iter().filter(has_no).map(|of| format!("{} shards (--profiles)", of.name()));
    let others = [
        (before.metric && !settings.inputs.metric && !is_geographic, "metres (--metric)"),
        (before.geo_reference.is_some() && !is_geographic, "a geo-reference (--geo)"),
        (settings.cells.occupancy.is_none() && has(occupancy::section::HEADER), "free places (--occupancy)"),
        (!settings.cells.landmarks && has(slag_common::landmarks::section::HEADER), "landmarks (--locate)"),
        (before.encoder.text_model.is_some() && !settings.output.text_model, "a text model (--text-model)"),
    ];
    others.iter().filter(|(is_lost, _)| *is_lost).map(|(_, what)| (*what).to_owned()).chain(shards).collect()
}

/// Draws a few views, and counts those that look less like their photo than a plain colour does, and all that tell.
fn unlike(inputs: &Inputs, scene: &dyn LoadedScene) -> [usize; 2] {
    let n = inputs.views.len();
    let mut counts = [0; 2];
    for view in (0..n.min(N_COMPARED)).map(|i| &inputs.views[i * n / n.min(N_COMPARED)]) {
        // Photos that cannot be read are told later, each by its name.
        let Ok(photo) = ingest::load_image(view) else { continue };
        if let Ok(Some(is_unlike)) = check::is_unlike(photo.into(), scene) {
            counts[0] += usize::from(is_unlike);
            counts[1] += 1;
        }
    }
    if are_unlike(counts) {
        let [n_unlike, of] = counts;
        tracing::warn!(
            "{n_unlike} of {of} compared views look less like their photos than a plain colour does: photos, poses and splat do \
             not belong together; slag-encoder check says why"
        );
    }
    counts
}

/// Finds and reports kept views that cannot be reused; an unfinished encode is refused later, not replaced.
fn lost_views(store: &Store, of_scene: Hash32) -> Result<Option<LostViews>, EncodeError> {
    let is_lost = |kept: &JobStatus| kept.n_views > 0 && kept.is_published && kept.of_scene != of_scene.0;
    let kept = job_status(store.db())?.filter(is_lost);
    let Some(JobStatus { n_views, .. }) = kept else { return Ok(None) };
    let reason = format!(
        "splat, models, device or settings of views are others than those of the {n_views} kept views, so no view is taken \
         over: what a Gaussian contributes to a photo depends on all those before it"
    );
    tracing::warn!("{reason}");
    Ok(Some(LostViews { n_views, reason }))
}

/// Reserves what is known of scene and settings; what depends on masks and contributions follows after the views.
fn memory_plan(settings: &EncodeSettings, inputs: &Inputs, engines: &Engines<'_>) -> MemoryPlan {
    let n_gaussians = inputs.scene.len();
    let mut memory = MemoryPlan::new(settings.run.memory_bytes);
    inputs::reserve(&mut memory, &inputs.scene);
    CellSplit::reserve(&mut memory, n_gaussians);
    ground::reserve(&mut memory, n_gaussians);
    raster::reserve(&mut memory, n_gaussians);
    shard::reserve(&mut memory, &inputs.split, engines.models.dim());
    Refinement::reserve(&mut memory, &settings.aggregation, n_gaussians);
    if settings.cells.objects {
        objects::reserve(&mut memory, n_gaussians, settings.aggregation.has_fine_superpoints());
    }
    if settings.cells.landmarks {
        landmarks::reserve(
            &mut memory,
            settings.run.views_limit.of(inputs.views.len()),
            &inputs.views,
            n_gaussians,
        );
    }
    memory
}

/// `standing`: things on the scene's ground.
pub(crate) fn segmenter_of(
    settings: &ViewSettings,
    gpus: &[u32],
    engines: &Engines<'_>,
    standing: &Arc<Standing>,
) -> Result<Box<dyn Segmenter>, EncodeError> {
    if settings.regions.have_masks() {
        open_segmenter(&settings.masks, engines.session, gpus, standing)
    } else if engines.models.patches_per_side().is_some() {
        Ok(Box::new(NoMasks))
    } else {
        Err(EncodeError::Failed(format!(
            "{} has no vectors of patches; give a model whose model.toml has image.patches, or leave --regions out",
            engines.models.encoder_id()
        )))
    }
}

fn open_segmenter(
    masks: &Masks,
    session: &SessionOptions,
    gpus: &[u32],
    standing: &Arc<Standing>,
) -> Result<Box<dyn Segmenter>, EncodeError> {
    let standing = Arc::clone(standing);
    Ok(match masks {
        Masks::Auto { n_levels } => {
            let settings = GraphSettings::learnt(*n_levels);
            let other = GraphSegmenter::learnt(settings, session, gpus).map_err(SegmentError::from)?;
            Box::new(WithStanding { other, standing })
        }
        Masks::Graph => Box::new(WithStanding { other: GraphSegmenter::default(), standing }),
        Masks::Given { dir, ignore_ids } => Box::new(GivenMasks::open(dir, ignore_ids.clone())?),
        Masks::Sam { dir, settings, n_model_threads } => {
            let session = SessionOptions { intra_op_threads: *n_model_threads, ..session.clone() };
            Box::new(SamSegmenter::open(dir, settings.clone(), &session, gpus)?)
        }
    })
}

/// Indices of the views to use, in order.
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
        // With a time budget every prefix must be spread, with a limit the whole.
        ViewOrder::Nth if run.time_budget.is_some() => {
            let chosen = spread(limit);
            (coverage::spread_order(limit).into_iter().map(|i| chosen[i]).collect(), None)
        }
        ViewOrder::Nth => (spread(limit), None),
        ViewOrder::Coverage => {
            let raster_views: Vec<RasterView> = views.iter().map(RasterView::of).collect();
            let measured = Coverage::measure(scene, inputs.scene.len(), &raster_views, context.cancel);
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
    use crate::raster::CpuRasterizer;
    use slag_common::Gaussians;
    use slag_models::ModelDir;

    /// Superpoints take more than 204 bytes a Gaussian after the views; a smaller budget is refused beforehand.
    #[test]
    fn what_refinement_takes_is_refused_before_the_first_view() {
        let mut settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        settings.run.memory_bytes = 100_000 * 204;
        let scene = Gaussians { means_in_world: vec![glam::DVec3::ZERO; 100_000], ..Gaussians::default() };
        let split = CellSplit::default();
        let inputs = Inputs {
            scene,
            split,
            standing: Arc::default(),
            views: Vec::new(),
            missing: Vec::new(),
            geo_reference: None,
        };
        let (models, session) = (ModelDir::colours(), SessionOptions::new(PathBuf::new()));
        let engines = Engines::new(&models, &session, &CpuRasterizer);
        let refused =
            memory_plan(&settings, &inputs, &engines).rest(0).expect_err("the objects' lists come on top");
        let most = refused.to_string();
        let (_, most) = most.split_once("needed at least: ").expect("before the first view");
        assert!(most.split(", ").next().is_some_and(|most| most.contains("superpoints")), "{refused}");
        settings.run.memory_bytes *= 2;
        memory_plan(&settings, &inputs, &engines).rest(0).expect("fits");
    }
}
