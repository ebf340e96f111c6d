//! The stages of one view: (fetch,) decode, (depth,) segment, crop, embed, raster, write.
//!
//! Each stage is a method that takes what the one before returns. Where an encode is spread over machines, photos come
//! from a [`PhotoSource`] and contributions go to a [`ViewSink`].

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Instant;

use image::RgbImage;
use serde::{Deserialize, Serialize};
use slag_common::View;
use slag_models::preprocess::Preprocess;
use slag_models::{Crop, ImageEncoder, ModelError, SessionOptions};

use super::context::{Engines, RunContext};
use super::error::EncodeError;
use super::inputs;
use super::pipeline::{self, Stage};
use super::settings::{Regions, ViewSettings};
use crate::cells::CellSplit;
use crate::embed::{self, PatchUse, SharedEncoders, Surroundings};
use crate::ingest::{self, LoadedImage, OddPhotos};
use crate::lanes::GpuLoad;
use crate::lift::ViewContributions;
use crate::lift::photos::MaskOutline;
use crate::masks::patches::{Windows, patch_masks};
use crate::masks::regions::{absorb_slivers, partition};
use crate::masks::{self, Mask, RegionMap};
use crate::memory::MemoryPlan;
use crate::raster::{LoadedScene, RasterView};
use crate::segment::{SegmentInput, Segmenter};

const PICTURE_WIDTH_PX: u32 = 480;

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewRecord {
    /// Width at which its weights were rasterised.
    pub(crate) raster_width_px: u32,
    /// Seconds in its stages before this record.
    pub(crate) secs: f32,
}

pub(crate) trait PhotoSource: Sync {
    fn n_at_once(&self) -> usize;

    /// Fetches a view's files to its paths; returns whether the view is still to be done.
    fn fetch(&self, view: &View) -> Result<bool, EncodeError>;
}

pub(crate) trait ViewSink: Sync {
    fn n_at_once(&self) -> usize;

    /// Refuses a view whose photo or masks changed since planning; those fetched by hash cannot have.
    fn check_unchanged(&self, _view: &View, _segmenter: &dyn Segmenter) -> Result<(), EncodeError> {
        Ok(())
    }

    /// Keeps a view's contributions and outlines; they are durable on return.
    fn keep(
        &self,
        view: &View,
        contributions: &ViewContributions,
        outlines: &[MaskOutline],
        record: ViewRecord,
    ) -> Result<(), EncodeError>;
}

#[derive(Clone, Copy)]
pub(crate) struct ViewTools<'a> {
    pub(crate) context: &'a RunContext<'a>,
    pub(crate) engines: &'a Engines<'a>,
    pub(crate) settings: &'a ViewSettings,
    pub(crate) n_threads: usize,
    pub(crate) gpus: &'a [u32],
    pub(crate) segmenter: &'a dyn Segmenter,
    pub(crate) scene: &'a dyn LoadedScene,
    pub(crate) split: &'a CellSplit,
    /// Fetches photos; `None` if they are on this machine.
    pub(crate) photos: Option<&'a dyn PhotoSource>,
    pub(crate) sink: &'a dyn ViewSink,
}

pub(crate) struct ViewStages<'a> {
    pub(super) tools: ViewTools<'a>,
    /// How crops become the image encoder's squares; `None` if it takes any size.
    preprocess: Option<Preprocess>,
    encoders: Encoders,
    /// Device of the image model, once open.
    images_on: Arc<OnceLock<Option<String>>>,
    odd_photos: OddPhotos,
    /// Most Gaussians in a view whose ellipses overflow the device's numbers.
    n_unrepresentable: AtomicUsize,
}

enum Encoders {
    /// Idle encoders on the processor, one per view in work, opened as needed.
    OfViews(Mutex<Vec<Box<dyn ImageEncoder>>>),
    Shared(SharedEncoders),
}

pub(crate) struct Work<'v> {
    pub(super) view: &'v View,
    next: Next,
    /// Of the stages so far.
    secs: f32,
}

enum Next {
    Fetch,
    Decode,
    Depth(LoadedImage),
    /// With camera z of the scene per pixel, if the segmenter needs it.
    Segment(LoadedImage, Option<Vec<f32>>),
    Crop(LoadedImage, Vec<Mask>),
    Embed(Cropped),
    /// With a unit vector for each mask.
    Raster(Vec<f32>, Partition),
    /// With the width at which weights were rasterised.
    Write(ViewContributions, Vec<MaskOutline>, u32),
}

struct Cropped {
    crops: Crops,
    /// Windows as the last masks, and their shares in the others.
    windows: Option<Surroundings>,
    /// The photo, if its patches are embedded, too.
    patches: Option<(Arc<RgbImage>, PatchUse)>,
    partition: Partition,
}

enum Crops {
    /// Squares of the model's size, for GPUs that batch several views.
    Squares(Vec<Crop>),
    /// Masks, cut from the photo batch by batch.
    Uncut(Arc<RgbImage>, Vec<Mask>),
}

/// Regions of a view, the masks that cover each, and the masks' outlines.
struct Partition {
    raster_view: RasterView,
    regions: RegionMap,
    masks_of_region: Vec<Vec<u32>>,
    outlines: Vec<MaskOutline>,
}

impl<'v> Work<'v> {
    pub(super) fn begin(view: &'v View, is_here: bool) -> Self {
        Self { view, next: if is_here { Next::Decode } else { Next::Fetch }, secs: 0.0 }
    }
}

impl ViewTools<'_> {
    /// In the order of [`ViewStages::step`].
    pub(super) fn stages(&self) -> Vec<Stage> {
        let raster_slots = self.scene.views_on_gpus();
        let on_cpu = |name| Stage { name, n_slots: self.n_threads, on_cpu: true };
        let on_device = |name, n_slots: Option<usize>| match n_slots {
            Some(n_slots) => Stage { name, n_slots, on_cpu: false },
            None => on_cpu(name),
        };
        let embeds_on_gpus = !self.engines.session.is_on_cpu();
        let embed_slots = embeds_on_gpus.then(|| SharedEncoders::n_views(self.gpus));
        let fetch = self.photos.map(|photos| on_device("fetch", Some(photos.n_at_once())));
        let mut stages: Vec<Stage> = fetch.into_iter().chain([on_cpu("decode")]).collect();
        if self.segmenter.wants_depth() {
            stages.push(on_device("depth", raster_slots));
        }
        stages.extend([
            on_device("segment", self.segmenter.concurrency()),
            on_cpu("crop"),
            on_device("embed", embed_slots),
            on_device("raster", raster_slots),
            on_device("write", Some(self.sink.n_at_once())),
        ]);
        stages
    }

    pub(crate) fn reserve(&self, memory: &mut MemoryPlan, views: &[View]) {
        let Engines { models, session, .. } = self.engines;
        let preprocess = models.preprocess();
        let on_gpus = preprocess.as_ref().filter(|_| !session.is_on_cpu());
        let wants_patches = self.settings.regions != Regions::Crops && models.patches_per_side().is_some();
        let stages = self.stages();
        let at = |name| stages.iter().position(|stage| stage.name == name).unwrap_or(0);
        // Photos are held until their crops are cut, or embedded.
        let last = at(if on_gpus.is_none() || wants_patches { "embed" } else { "crop" });
        let n_under_way = pipeline::most_under_way(&stages, at("decode")..=last, self.n_threads);
        inputs::reserve_photos(memory, views, self.n_threads, n_under_way);
        let crops_bytes = |photo_px: u64| match on_gpus {
            // One crop being cut.
            Some(_) => 4 * photo_px,
            None => embed::batch_bytes(preprocess.as_ref(), photo_px),
        };
        inputs::reserve_crops(memory, views, self.n_threads, crops_bytes);
        if let Some(preprocess) = on_gpus {
            // A byte per channel, and one for the mask.
            SharedEncoders::reserve(memory, self.gpus, 4 * u64::from(preprocess.size_px()).pow(2));
        }
    }
}

impl<'a> ViewStages<'a> {
    pub(crate) fn new(tools: ViewTools<'a>) -> Self {
        let (models, session) = (tools.engines.models.clone(), tools.engines.session.clone());
        let preprocess = models.preprocess();
        let is_on_cpu = session.is_on_cpu();
        let images_on = Arc::<OnceLock<_>>::default();
        let is_on = Arc::clone(&images_on);
        let open = move |gpu| {
            let encoder = models.image_encoder(&SessionOptions { gpu, ..session.clone() })?;
            is_on.get_or_init(|| encoder.placement().map(ToString::to_string));
            Ok(encoder)
        };
        let encoders = match is_on_cpu {
            true => Encoders::OfViews(Mutex::default()),
            false => Encoders::Shared(SharedEncoders::new(tools.gpus, Box::new(open))),
        };
        Self {
            tools,
            preprocess,
            encoders,
            images_on,
            odd_photos: OddPhotos::default(),
            n_unrepresentable: AtomicUsize::new(0),
        }
    }

    pub(super) fn loads(&self, stage: &str) -> Vec<GpuLoad> {
        match (stage, &self.encoders) {
            ("segment", _) => self.tools.segmenter.loads(),
            ("embed", Encoders::Shared(encoders)) => encoders.loads(),
            _ => Vec::new(),
        }
    }

    /// Device of the image model, if it ran.
    pub(crate) fn images_on(&self) -> Option<String> {
        self.images_on.get().cloned().flatten()
    }

    pub(super) fn warn(&self) {
        self.odd_photos.warn();
        let n = self.n_unrepresentable.load(Ordering::Relaxed);
        if n > 0 {
            let is_on_gpu = self.tools.scene.views_on_gpus().is_some();
            let advice =
                if is_on_gpu { "; on a GPU without f64, --device cpu draws more of them" } else { "" };
            tracing::warn!(
                "up to {n} Gaussians of a view contribute nothing: their ellipses are beyond the numbers of the device{advice}"
            );
        }
    }

    /// Does the view's next stage; `None` after the last.
    pub(super) fn step<'v>(&self, work: Work<'v>) -> Result<Option<Work<'v>>, EncodeError> {
        let (start, view) = (Instant::now(), work.view);
        let next = match work.next {
            Next::Fetch => match self.tools.photos {
                Some(photos) if !photos.fetch(view)? => return Ok(None),
                _ => Next::Decode,
            },
            Next::Decode => {
                let loaded = ingest::load_image(view)?;
                self.odd_photos.add(&loaded);
                match self.tools.segmenter.wants_depth() {
                    true => Next::Depth(loaded),
                    false => Next::Segment(loaded, None),
                }
            }
            Next::Depth(loaded) => {
                let depth = self.depth(view, &loaded)?;
                Next::Segment(loaded, Some(depth))
            }
            Next::Segment(loaded, depth) => {
                let masks = self.segment(view, &loaded, depth.as_deref())?;
                Next::Crop(loaded, masks)
            }
            Next::Crop(loaded, masks) => Next::Embed(self.crop(view, loaded, masks)?),
            Next::Embed(cropped) => {
                let Cropped { crops, windows, patches, partition } = cropped;
                Next::Raster(self.embed(view, crops, windows, patches)?, partition)
            }
            Next::Raster(vectors, partition) => self.lift(view, vectors, partition)?,
            Next::Write(contributions, outlines, raster_width_px) => {
                self.tools.sink.check_unchanged(view, self.tools.segmenter)?;
                let record = ViewRecord { raster_width_px, secs: work.secs };
                self.tools.sink.keep(view, &contributions, &outlines, record)?;
                self.tools.context.progress.advance(1);
                return Ok(None);
            }
        };
        Ok(Some(Work { view, next, secs: work.secs + start.elapsed().as_secs_f32() }))
    }

    fn depth(&self, view: &View, loaded: &LoadedImage) -> Result<Vec<f32>, EncodeError> {
        let width = self.tools.settings.raster_width;
        let raster_view = raster_view(loaded, width.px(loaded.view.intrinsics.width_px));
        // A GPU waits for colours that these threads compute, rather than they for it.
        let draw = || self.tools.scene.draw(&raster_view, [0.0; 3]);
        let drawing = self
            .tools
            .context
            .install(draw)
            .map_err(|source| EncodeError::Raster { view: view.name.clone(), source })?;
        // Holes of the scene have no depth.
        let seen = drawing.depth.iter().zip(&drawing.coverage);
        let seen: Vec<f32> = seen.map(|(depth, share)| if *share > 0.5 { *depth } else { 0.0 }).collect();
        Ok(enlarge(&seen, &raster_view, loaded))
    }

    fn segment(
        &self,
        view: &View,
        loaded: &LoadedImage,
        depth: Option<&[f32]>,
    ) -> Result<Vec<Mask>, EncodeError> {
        let pool = Some(&self.tools.context.workers.shared);
        let input = SegmentInput { pool, ..SegmentInput::new(loaded, depth) };
        let mut masks = self.tools.segmenter.segment(&input)?;
        let min_mask_px = self.tools.settings.min_mask_px;
        masks.retain(|mask| mask.level == Mask::STANDING || mask.area_px >= min_mask_px);
        let draw = || masks::overlay(&loaded.image, &masks, PICTURE_WIDTH_PX);
        self.tools.context.progress.segmented(&view.name, masks.len(), &draw);
        Ok(masks)
    }

    fn crop(&self, view: &View, loaded: LoadedImage, mut masks: Vec<Mask>) -> Result<Cropped, EncodeError> {
        let (patches, regions) = self.patches(&loaded.image, &masks);
        let partition = self.partition(&loaded, regions.as_ref().unwrap_or(&masks));
        let windows = self.windows(&loaded.image, &masks).map(|windows| {
            let of = Surroundings::of_windows(&masks, &windows);
            masks.extend(windows.masks());
            of
        });
        let photo = Arc::new(loaded.image);
        let crops = match (&self.preprocess, &self.encoders) {
            (Some(preprocess), Encoders::Shared(_)) => Crops::Squares(
                embed::squares(&photo, &masks, preprocess)
                    .map_err(|source| EncodeError::Embed { view: view.name.clone(), source })?,
            ),
            _ => Crops::Uncut(Arc::clone(&photo), masks),
        };
        let patches = patches.map(|uses| (photo, uses));
        Ok(Cropped { crops, windows, patches, partition })
    }

    /// How a photo's patches are used, and the regions they form in place of masks.
    fn patches(&self, photo: &RgbImage, masks: &[Mask]) -> (Option<PatchUse>, Option<Vec<Mask>>) {
        let Some(per_side) = self.tools.engines.models.patches_per_side() else { return (None, None) };
        let (width_px, height_px) = photo.dimensions();
        match self.tools.settings.regions {
            Regions::Masks if !masks.is_empty() => {
                let of = Surroundings::of_patches(masks, per_side, (width_px, height_px));
                (Some(PatchUse::Masks(of)), None)
            }
            Regions::Crops | Regions::Masks => (None, None),
            Regions::Patches => {
                let (numbers, regions) = patch_masks(per_side, width_px, height_px).into_iter().unzip();
                (Some(PatchUse::Regions(numbers)), Some(regions))
            }
        }
    }

    /// Windows that masks take a share of, for a model that wants them and has no patches.
    fn windows(&self, photo: &RgbImage, masks: &[Mask]) -> Option<Windows> {
        let models = self.tools.engines.models;
        let has_patches = models.patches_per_side().is_some();
        let wanted = self.tools.settings.regions == Regions::Masks && !has_patches && !masks.is_empty();
        wanted.then(|| Windows::new(models.windows(), photo.width(), photo.height()))
    }

    fn partition(&self, loaded: &LoadedImage, masks: &[Mask]) -> Partition {
        let width = self.tools.settings.raster_width;
        let raster_view = raster_view(loaded, width.px(loaded.view.intrinsics.width_px));
        let raster_px = [raster_view.intrinsics.width_px, raster_view.intrinsics.height_px];
        let (image, valid) = (&loaded.image, loaded.valid.as_deref());
        let (width_px, height_px) = image.dimensions();
        let (mut regions, mut masks_of_region) =
            partition(masks, width_px, height_px, raster_px[0], raster_px[1], valid);
        if self.tools.settings.merges_slivers {
            absorb_slivers(&mut regions, &mut masks_of_region);
        }
        let outlines = masks.iter().map(|mask| MaskOutline::of(mask, width_px, height_px, valid)).collect();
        Partition { raster_view, regions, masks_of_region, outlines }
    }

    /// Returns `[n_masks][dim]`, unit.
    fn embed(
        &self,
        view: &View,
        crops: Crops,
        windows: Option<Surroundings>,
        patches: Option<(Arc<RgbImage>, PatchUse)>,
    ) -> Result<Vec<f32>, EncodeError> {
        let failed = |source| EncodeError::Embed { view: view.name.clone(), source };
        let mut vectors = match (&self.encoders, crops) {
            (_, Crops::Squares(crops)) if crops.is_empty() => Vec::new(),
            (Encoders::Shared(encoders), Crops::Squares(crops)) => {
                encoders.embed(crops).map_err(|failure| match failure {
                    embed::Failure::Model(error) => error.into(),
                    embed::Failure::Embed(source) => failed(source),
                })?
            }
            (_, Crops::Squares(crops)) => {
                self.with_encoder(|encoder| embed::embed_crops(&crops, 0, encoder))?.map_err(failed)?
            }
            (_, Crops::Uncut(photo, masks)) => self
                .with_encoder(|encoder| {
                    embed::embed_masks(&photo, &masks, self.preprocess.as_ref(), encoder, None)
                })?
                .map_err(failed)?,
        };
        if let Some((photo, patches)) = patches {
            self.with_encoder(|encoder| patches.add_to(&photo, &mut vectors, encoder))?.map_err(failed)?;
        }
        if let Some(windows) = windows {
            let dim = self.tools.engines.models.dim();
            let of_windows = vectors.split_off(windows.n_masks() * dim);
            windows.mix(&mut vectors, &of_windows, dim);
        }
        Ok(vectors)
    }

    fn with_encoder<T>(&self, work: impl FnOnce(&mut dyn ImageEncoder) -> T) -> Result<T, ModelError> {
        let idle = match &self.encoders {
            Encoders::Shared(encoders) => return encoders.with_encoder(work),
            Encoders::OfViews(idle) => || idle.lock().unwrap_or_else(PoisonError::into_inner),
        };
        let free = idle().pop();
        let mut encoder = match free {
            Some(encoder) => encoder,
            None => self.tools.engines.models.image_encoder(self.tools.engines.session)?,
        };
        self.images_on.get_or_init(|| encoder.placement().map(ToString::to_string));
        let result = work(encoder.as_mut());
        idle().push(encoder);
        Ok(result)
    }

    fn lift(&self, view: &View, vectors: Vec<f32>, partition: Partition) -> Result<Next, EncodeError> {
        let Partition { raster_view, regions, masks_of_region, outlines } = partition;
        let ViewTools { engines, scene, split, .. } = self.tools;
        let weights = scene
            .weights(&raster_view, &regions)
            .map_err(|source| EncodeError::Raster { view: view.name.clone(), source })?;
        let n_unrepresentable = weights.counters.unusable.saturating_sub(split.n_rejected);
        self.n_unrepresentable.fetch_max(n_unrepresentable, Ordering::Relaxed);
        let dim = engines.models.dim();
        let contributions = ViewContributions::new(&weights.entries, masks_of_region, vectors, dim, split);
        Ok(Next::Write(contributions, outlines, raster_view.intrinsics.width_px))
    }
}

fn raster_view(loaded: &LoadedImage, width_px: u32) -> RasterView {
    let intrinsics = loaded.view.intrinsics.scaled_to_width(width_px);
    RasterView { intrinsics, ..RasterView::of(&loaded.view) }
}

/// Enlarges a raster's values to the photo's size, nearest neighbour.
fn enlarge(values: &[f32], raster_view: &RasterView, loaded: &LoadedImage) -> Vec<f32> {
    let (width, height) = (u64::from(loaded.image.width()), u64::from(loaded.image.height()));
    let (from_width, from_height) =
        (u64::from(raster_view.intrinsics.width_px), u64::from(raster_view.intrinsics.height_px));
    let mut out = Vec::with_capacity((width * height) as usize);
    for y in 0..height {
        let row = (2 * y + 1) * from_height / (2 * height) * from_width;
        out.extend((0..width).map(|x| values[(row + (2 * x + 1) * from_width / (2 * width)) as usize]));
    }
    out
}
