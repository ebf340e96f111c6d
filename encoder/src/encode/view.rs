//! The stages of one view: decode, (depth,) segment, crop, embed, raster, write.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Instant;

use image::RgbImage;
use slag_common::View;
use slag_models::preprocess::Preprocess;
use slag_models::{Crop, ImageEncoder, SessionOptions};

use super::context::RunContext;
use super::engines::Engines;
use super::error::EncodeError;
use super::pipeline::Stage;
use super::settings::{Regions, ViewSettings};
use super::sink::{PhotoSource, ViewRecord, ViewSink};
use crate::cells::CellSplit;
use crate::embed::{self, EmbedError, PatchUse, PhotoPatches, SharedEncoders, Surroundings};
use crate::ingest::{self, LoadedImage, RotatedPhotos};
use crate::lanes::GpuLoad;
use crate::lift::ViewContributions;
use crate::lift::photos::MaskOutline;
use crate::masks::patches::patch_masks;
use crate::masks::regions::{absorb_slivers, partition};
use crate::masks::windows::Windows;
use crate::masks::{self, Mask, RegionMap};
use crate::raster::{GpuSlots, LoadedScene, RasterError, RasterView};
use crate::segment::{SegmentInput, Segmenter};

/// Width of pictures of masks for people.
const PICTURE_WIDTH_PX: u32 = 480;

/// What every view needs on its way.
#[derive(Clone, Copy)]
pub(crate) struct ViewTools<'a> {
    pub(crate) engines: &'a Engines<'a>,
    pub(crate) settings: &'a ViewSettings,
    pub(crate) n_threads: usize,
    /// GPUs for the models.
    pub(crate) gpus: &'a [u32],
    pub(crate) segmenter: &'a dyn Segmenter,
    pub(crate) scene: &'a dyn LoadedScene,
    pub(crate) split: &'a CellSplit,
    /// Brings photos to this machine; `None` where they are.
    pub(crate) photos: Option<&'a dyn PhotoSource>,
    pub(crate) sink: &'a dyn ViewSink,
}

/// The stages of a view, with what every view needs.
pub(crate) struct ViewStages<'a> {
    tools: ViewTools<'a>,
    context: &'a RunContext<'a>,
    /// How crops become the image encoder's squares; `None` if it takes crops of any size.
    preprocess: Option<Preprocess>,
    encoders: Encoders,
    /// The device that runs the image model, once it is open.
    images_on: Arc<OnceLock<Option<String>>>,
    pub(super) rotated: RotatedPhotos,
}

/// The image encoders.
enum Encoders {
    /// One for each view at work, on the processor; those that are not at work. They are opened as they are needed.
    OfViews(Mutex<Vec<Box<dyn ImageEncoder>>>),
    /// On GPUs, for the crops of all views.
    Shared(SharedEncoders),
}

/// A view between two stages, with what the next one needs.
pub(crate) struct Work<'v> {
    view: &'v View,
    next: Next,
    /// Seconds of the stages so far.
    secs: f32,
}

#[expect(clippy::large_enum_variant, reason = "a handful at a time, moved a few times a view")]
enum Next {
    Fetch,
    Decode,
    Depth(LoadedImage),
    Segment(LoadedImage, Option<Vec<f32>>),
    Crop(LoadedImage, Vec<Mask>),
    Embed(Crops, Option<PhotoPatches>, Option<Surroundings>, Partition),
    Raster(Vec<f32>, Partition),
    Write(ViewContributions, Vec<MaskOutline>, u32),
}

/// The crops to embed.
#[expect(clippy::large_enum_variant, reason = "a handful at a time, moved a few times a view")]
enum Crops {
    /// Squares of the model's size.
    Squares(Vec<Crop>),
    /// For a model that takes crops of any size: they are cut a batch at a time.
    Uncut(LoadedImage, Vec<Mask>),
}

/// The regions of a view, the masks that cover each, and the outlines of masks.
struct Partition {
    raster_view: RasterView,
    regions: RegionMap,
    masks_of_region: Vec<Vec<u32>>,
    outlines: Vec<MaskOutline>,
    /// Pixels of the base width in one of the raster, so that a finer view does not count more.
    weight_scale: f32,
}

impl<'v> Work<'v> {
    pub(super) fn begin(view: &'v View, is_here: bool) -> Self {
        Self { view, next: if is_here { Next::Decode } else { Next::Fetch }, secs: 0.0 }
    }

    pub(super) fn view(&self) -> &'v View {
        self.view
    }
}

impl<'a> ViewStages<'a> {
    /// Makes the stages; models are opened when the first view needs them.
    pub(crate) fn new(tools: ViewTools<'a>, context: &'a RunContext<'a>) -> Self {
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
        Self { tools, context, preprocess, encoders, images_on, rotated: RotatedPhotos::default() }
    }

    /// Returns the load of each GPU by the models of a stage.
    pub(super) fn loads(&self, stage: &str) -> Vec<GpuLoad> {
        match (stage, &self.encoders) {
            ("segment", _) => self.tools.segmenter.loads(),
            ("embed", Encoders::Shared(encoders)) => encoders.loads(),
            _ => Vec::new(),
        }
    }

    /// Returns whether photos are on this machine.
    pub(super) fn has_photos(&self) -> bool {
        self.tools.photos.is_none()
    }

    /// Returns the device that ran the image model, if it ran.
    pub(crate) fn images_on(&self) -> Option<String> {
        self.images_on.get().cloned().flatten()
    }

    /// Returns the stages, in the order in which [`Self::step`] goes through them.
    pub(super) fn stages(&self) -> Vec<Stage> {
        let n_cores = self.tools.n_threads;
        let raster_slots = self.tools.scene.gpus().map(GpuSlots::n_views);
        let on_cpu = |name| Stage { name, n_slots: n_cores, on_cpu: true };
        let on_device = |name, n_slots: Option<usize>| match n_slots {
            Some(n_slots) => Stage { name, n_slots, on_cpu: false },
            None => on_cpu(name),
        };
        let embed_slots = match &self.encoders {
            Encoders::OfViews(_) => None,
            Encoders::Shared(_) => Some(SharedEncoders::n_views(self.tools.gpus)),
        };
        let fetch = self.tools.photos.map(|photos| on_device("fetch", Some(photos.n_at_once())));
        let mut stages: Vec<Stage> = fetch.into_iter().chain([on_cpu("decode")]).collect();
        if self.tools.segmenter.wants_depth() {
            stages.push(on_device("depth", raster_slots));
        }
        stages.extend([
            on_device("segment", self.tools.segmenter.concurrency()),
            on_cpu("crop"),
            on_device("embed", embed_slots),
            on_device("raster", raster_slots),
            on_device("write", Some(self.tools.sink.n_at_once())),
        ]);
        stages
    }

    /// Does the work of the view's next stage.
    pub(super) fn step<'v>(&self, work: Work<'v>) -> Result<Option<Work<'v>>, EncodeError> {
        let start = Instant::now();
        let view = work.view;
        let raster_failed = |source: RasterError| EncodeError::Raster { view: view.name.clone(), source };
        let next = match work.next {
            Next::Fetch => {
                if let Some(photos) = self.tools.photos
                    && !photos.fetch(view)?
                {
                    return Ok(None);
                }
                Next::Decode
            }
            Next::Decode => {
                let loaded = ingest::load_image(view)?;
                self.rotated.add(&loaded);
                match self.tools.segmenter.wants_depth() {
                    true => Next::Depth(loaded),
                    false => Next::Segment(loaded, None),
                }
            }
            Next::Depth(loaded) => {
                let width = self.tools.settings.raster_width;
                let raster_view = raster_view(&loaded, width.base_px(loaded.view.intrinsics.width_px));
                // A GPU waits for colours that these threads compute, rather than they for it.
                let draw = || self.tools.scene.draw(&raster_view, [0.0; 3]);
                let drawing = self.context.install(draw).map_err(raster_failed)?;
                let seen = drawing.depth.iter().zip(&drawing.coverage);
                // What shows through the scene's holes is nobody's depth.
                let seen: Vec<f32> =
                    seen.map(|(depth, share)| if *share > 0.5 { *depth } else { 0.0 }).collect();
                let depth = enlarge(&seen, &raster_view, &loaded);
                Next::Segment(loaded, Some(depth))
            }
            Next::Segment(loaded, depth) => {
                let pool = Some(self.context.pool());
                let input = SegmentInput { pool, ..SegmentInput::new(&loaded, depth.as_deref()) };
                let mut masks = self.tools.segmenter.segment(&input)?;
                if let Some(perturbation) = self.tools.engines.perturbation {
                    masks = perturbation.masks(&view.name, masks, loaded.image.dimensions().into());
                }
                masks.retain(|mask| mask.area_px >= self.tools.settings.min_mask_px);
                let draw = || masks::overlay(&loaded.image, &masks, PICTURE_WIDTH_PX);
                self.context.progress().segmented(&view.name, masks.len(), &draw);
                Next::Crop(loaded, masks)
            }
            Next::Crop(loaded, mut masks) => {
                let (patches, regions) = self.patches(&loaded.image, &masks);
                let partition = self.partition(&loaded, regions.as_ref().unwrap_or(&masks));
                let windows = self.windows(&loaded.image, &masks).map(|windows| {
                    let of = Surroundings::of_windows(&masks, &windows);
                    masks.extend(windows.masks());
                    of
                });
                let crops = match &self.preprocess {
                    Some(preprocess) => Crops::Squares(
                        embed::squares(&loaded.image, &masks, self.tools.settings.background, preprocess)
                            .map_err(|source| EncodeError::Embed { view: view.name.clone(), source })?,
                    ),
                    None => Crops::Uncut(loaded, masks),
                };
                Next::Embed(crops, patches, windows, partition)
            }
            Next::Embed(crops, patches, windows, partition) => {
                let mut vectors = self.embed(view, crops, patches.as_ref())?;
                if let Some(windows) = windows {
                    let dim = self.tools.engines.models.dim();
                    let of_windows = vectors.split_off(windows.n_masks() * dim);
                    windows.mix(&mut vectors, &of_windows, dim);
                }
                if let Some(perturbation) = self.tools.engines.perturbation {
                    perturbation.vectors(&view.name, &mut vectors, self.tools.engines.models.dim());
                }
                Next::Raster(vectors, partition)
            }
            Next::Raster(vectors, partition) => {
                let Partition { raster_view, regions, masks_of_region, outlines, weight_scale } = partition;
                let mut weights = self
                    .tools
                    .scene
                    .weights(&raster_view, &regions, self.tools.settings.weights)
                    .map_err(raster_failed)?;
                weights.entries.iter_mut().for_each(|entry| entry.weight *= weight_scale);
                let dim = self.tools.engines.models.dim();
                let contributions =
                    ViewContributions::new(&weights.entries, masks_of_region, vectors, dim, self.tools.split);
                Next::Write(contributions, outlines, raster_view.intrinsics.width_px)
            }
            Next::Write(contributions, outlines, raster_width_px) => {
                let record = ViewRecord { raster_width_px, secs: work.secs };
                self.tools.sink.keep(view, &contributions, &outlines, record)?;
                self.context.progress().advance(1);
                return Ok(None);
            }
        };
        Ok(Some(Work { view, next, secs: work.secs + start.elapsed().as_secs_f32() }))
    }

    /// Returns the patches of a photo that have vectors, and the regions that they are in place of masks.
    fn patches(&self, photo: &RgbImage, masks: &[Mask]) -> (Option<PhotoPatches>, Option<Vec<Mask>>) {
        let Some(per_side) = self.tools.engines.models.patches_per_side() else { return (None, None) };
        let patches = |uses| Some(PhotoPatches { photo: photo.clone(), uses });
        let (width_px, height_px) = photo.dimensions();
        match self.tools.settings.regions {
            Regions::Crops => (None, None),
            Regions::Masks if masks.is_empty() => (None, None),
            Regions::Masks => {
                let of = Surroundings::of_patches(masks, per_side, (width_px, height_px));
                (patches(PatchUse::Masks(of)), None)
            }
            Regions::Patches => {
                let (numbers, regions) = patch_masks(per_side, width_px, height_px).into_iter().unzip();
                (patches(PatchUse::Regions(numbers)), Some(regions))
            }
        }
    }

    /// Returns the windows that masks take a share of: of a model that wants them, and has no patches.
    fn windows(&self, photo: &RgbImage, masks: &[Mask]) -> Option<Windows> {
        let models = self.tools.engines.models;
        let has_patches = models.patches_per_side().is_some();
        let wanted = self.tools.settings.regions == Regions::Masks && !has_patches && !masks.is_empty();
        wanted.then(|| Windows::new(models.windows(), photo.width(), photo.height()))
    }

    /// Makes the regions of a view's masks.
    fn partition(&self, loaded: &LoadedImage, masks: &[Mask]) -> Partition {
        let (width, photo_px) = (self.tools.settings.raster_width, loaded.view.intrinsics.width_px);
        let raster_view = raster_view(loaded, width.px(photo_px));
        let raster_px = [raster_view.intrinsics.width_px, raster_view.intrinsics.height_px];
        let (image, valid) = (&loaded.image, loaded.valid.as_deref());
        let (width_px, height_px) = image.dimensions();
        let (mut regions, mut masks_of_region) =
            partition(masks, width_px, height_px, raster_px[0], raster_px[1], valid);
        if self.tools.settings.merges_slivers {
            absorb_slivers(&mut regions, &mut masks_of_region);
        }
        let weight_scale = (f64::from(width.base_px(photo_px)) / f64::from(raster_px[0])).powi(2) as f32;
        let outlines = masks.iter().map(|mask| MaskOutline::of(mask, width_px, height_px, valid)).collect();
        Partition { raster_view, regions, masks_of_region, outlines, weight_scale }
    }

    /// Returns a vector per mask, or per patch that is a region.
    fn embed(
        &self,
        view: &View,
        crops: Crops,
        patches: Option<&PhotoPatches>,
    ) -> Result<Vec<f32>, EncodeError> {
        if patches.is_none() && matches!(&crops, Crops::Squares(crops) if crops.is_empty()) {
            return Ok(Vec::new());
        }
        let failed = |source| EncodeError::Embed { view: view.name.clone(), source };
        match (&self.encoders, crops) {
            (Encoders::OfViews(idle), crops) => {
                let idle = || idle.lock().unwrap_or_else(PoisonError::into_inner);
                let free = idle().pop();
                let mut encoder = match free {
                    Some(encoder) => encoder,
                    None => self.tools.engines.models.image_encoder(self.tools.engines.session)?,
                };
                self.images_on.get_or_init(|| encoder.placement().map(ToString::to_string));
                let vectors = self.embed_with(encoder.as_mut(), &crops, patches);
                idle().push(encoder);
                vectors.map_err(failed)
            }
            (Encoders::Shared(encoders), Crops::Squares(crops)) => {
                let mut vectors = encoders.embed(crops).map_err(|failure| match failure {
                    embed::Failure::Model(error) => error.into(),
                    embed::Failure::Embed(source) => failed(source),
                })?;
                if let Some(patches) = patches {
                    encoders
                        .with_encoder(|encoder| patches.add_to(&mut vectors, encoder))?
                        .map_err(failed)?;
                }
                Ok(vectors)
            }
            (Encoders::Shared(encoders), crops) => {
                encoders.with_encoder(|encoder| self.embed_with(encoder, &crops, patches))?.map_err(failed)
            }
        }
    }

    fn embed_with(
        &self,
        encoder: &mut dyn ImageEncoder,
        crops: &Crops,
        patches: Option<&PhotoPatches>,
    ) -> Result<Vec<f32>, EmbedError> {
        let mut vectors = match crops {
            Crops::Squares(crops) => embed::embed_crops(crops, 0, encoder)?,
            Crops::Uncut(loaded, masks) => {
                let background = self.tools.settings.background;
                embed::embed_masks(&loaded.image, masks, encoder, background, None)?
            }
        };
        if let Some(patches) = patches {
            patches.add_to(&mut vectors, encoder)?;
        }
        Ok(vectors)
    }
}

/// Returns the view as a raster of a width.
fn raster_view(loaded: &LoadedImage, width_px: u32) -> RasterView {
    RasterView {
        camera_from_world: loaded.view.camera_from_world,
        intrinsics: loaded.view.intrinsics.scaled_to_width(width_px),
    }
}

/// Returns a raster's values at the photo's size, nearest.
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
