//! Scene, views and geo-reference as they were read, and the hash that tells two encodes apart.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Value, json};
use slag_common::frames::GeoReference;
use slag_common::poses::{self, ViewSet};
use slag_common::splat::{self, ReadOptions};
use slag_common::{Gaussians, Hash32, Intrinsics, View};

use super::context::{Engines, RunContext};
use super::error::EncodeError;
use super::report::SkippedView;
use super::settings::{EncodeSettings, InputSettings, MAX_RASTER_WIDTH_PX, ViewSettings};
use crate::cells::{self, CellSplit, PositionError};
use crate::ground::up::{Sign, Up};
use crate::ground::{Standing, up_by};
use crate::memory::{MemoryPlan, Phase};
use crate::raster::{RasterView, check_near_plane};
use crate::segment::Segmenter;
use crate::viewpoints::{self, ViewpointError, ViewpointSettings};
use crate::{check, ingest};

/// A splat is damaged if fewer than one in this many Gaussians can be seen.
const MIN_VISIBLE_ONE_IN: usize = 20;

/// Bytes per pixel of a photo in work: three as read and three without distortion, one for validity, four each for
/// depth and segment, and its masks.
const PHOTO_BYTES_PER_PX: u64 = 3 + 3 + 1 + 4 + 4 + MASK_BYTES_PER_PX;
/// The same while it waits: colours, validity, depth, masks.
const WAITING_BYTES_PER_PX: u64 = 3 + 1 + 4 + MASK_BYTES_PER_PX;
/// One bit per pixel of a mask's box: 32 masks as large as the photo, or hundreds of usual ones.
const MASK_BYTES_PER_PX: u64 = 4;

pub(crate) struct Inputs {
    pub(crate) scene: Gaussians,
    pub(crate) split: CellSplit,
    pub(crate) standing: Arc<Standing>,
    /// Views with a photo, by name.
    pub(crate) views: Vec<View>,
    /// Views without a photo, in the same order.
    pub(super) missing: Vec<SkippedView>,
    pub(super) geo_reference: Option<GeoReference>,
}

impl Inputs {
    /// Reads scene, poses and geo-reference, and splits the scene into cells.
    pub(super) fn read(settings: &EncodeSettings, context: &RunContext<'_>) -> Result<Self, EncodeError> {
        let inputs = &settings.inputs;
        let geo_reference = inputs.geo.as_deref().map(ingest::read_geo_reference).transpose()?;
        let options = ReadOptions { with_sh_rest: false };
        let mut scene = context.time("read", || splat::read(&inputs.scene, &options))?;
        inputs.activated.undo(&mut scene);
        let set = read_views(inputs)?;
        let damaged = set.damaged;
        // Drawings share the splat's world.
        if ingest::drawn_from(&inputs.views).is_none() {
            ingest::to_poses(&mut scene, &inputs.scene, &inputs.splat_frame, set.source, set.applied)?;
        }
        let (views, mut missing) = find_views(settings, set.views)?;
        if let (true, Some((view, reason))) = (settings.run.strict, damaged.first()) {
            return Err(EncodeError::Failed(format!(
                "view {view} has no pose: {reason}; remove it from the poses, or leave out --strict"
            )));
        }
        missing.extend(damaged.into_iter().map(|(view, reason)| SkippedView { view, reason }));
        context.install(|| check::suspicions(&scene, &views)).iter().for_each(|suspicion| {
            tracing::warn!("{}; `slag-encoder check` tells more", suspicion.text);
        });
        check_near_plane(&scene, &views.iter().map(RasterView::of).collect::<Vec<_>>())?;
        let limits = settings.cells.limits;
        check_cells(scene.len().div_ceil(limits.max_gaussians))?;
        let split = context.time("cells", || context.install(|| cells::split(&scene, limits)));
        check_cells(split.cells.len())?;
        let n_visible =
            (0..scene.len()).filter(|i| scene.is_usable(*i) && scene.opacities[*i] >= 1.0 / 255.0).count();
        if split.cells.is_empty() || n_visible * MIN_VISIBLE_ONE_IN < scene.len() {
            return Err(EncodeError::Failed(format!(
                "{}: hardly any of {} Gaussians can be seen (finite, positive scales, a rotation, not transparent); export the \
                 splat again",
                inputs.scene.display(),
                scene.len()
            )));
        }
        if split.n_for_precision > cells::MAX_CELLS_FOR_PRECISION {
            let (n, most) = (split.n_for_precision, cells::MAX_CELLS_FOR_PRECISION);
            let asked = match limits.position_error {
                PositionError::Within(error) => format!("{error:?} world units"),
                PositionError::OfSize => "a quarter of the size of small Gaussians".into(),
            };
            let problem = format!(
                "{asked} would take {n} more cells, expected at most {most}; give a larger --position-error, or remove Gaussians far \
                 from the scene"
            );
            return Err(EncodeError::Setting { setting: "--position-error".into(), problem });
        }
        let stands = || {
            let up = up_by(&scene, &views);
            if settings.inputs.metric || geo_reference.is_some() {
                check_up(&up);
            }
            Standing::below(&scene, up.axis)
        };
        let standing = Arc::new(context.time("ground", || context.install(stands)));
        Ok(Self { scene, split, standing, views, missing, geo_reference })
    }
}

/// Warns if the surfaces of a metric scene suggest that z does not point up.
fn check_up(&Up { axis, sign }: &Up) {
    if sign <= Sign::Unknown && axis.z < LEAST_UP_Z {
        tracing::warn!(
            "metres are stated, with z up, but surfaces and photos suggest that up is ({:.2}, {:.2}, {:.2}): if so, robots find no \
             ground; turn poses and splat, or leave out --metric and the geo-reference",
            axis.x,
            axis.y,
            axis.z
        );
    }
}

/// Cosine of the angle from z at which surfaces are no ground: 30 degrees, beyond any slope that robots drive on.
const LEAST_UP_Z: f64 = 0.866;

fn check_cells(n: usize) -> Result<(), EncodeError> {
    if n <= cells::MAX_CELLS {
        return Ok(());
    }
    let problem = format!(
        "the scene would have {n} cells or more, expected at most {}; raise --cell-gaussians and --cell-width-m",
        cells::MAX_CELLS
    );
    Err(EncodeError::Setting { setting: "--cell-gaussians".into(), problem })
}

pub(super) fn reserve(memory: &mut MemoryPlan, scene: &Gaussians) {
    memory.reserve(Phase::Always, "the scene", scene.len_bytes());
}

/// Reserves the largest photos: those in work, and those that wait for a device or in a queue.
pub(super) fn reserve_photos(memory: &mut MemoryPlan, views: &[View], n_in_work: usize, n_under_way: usize) {
    let areas_px = areas_px(views);
    let (in_work, rest) = areas_px.split_at(n_in_work.min(areas_px.len()));
    let waiting_px: u64 = rest.iter().take(n_under_way.saturating_sub(n_in_work)).sum();
    memory.reserve(Phase::Views, "photos in work", in_work.iter().sum::<u64>() * PHOTO_BYTES_PER_PX);
    memory.reserve(Phase::Views, "photos that wait", waiting_px * WAITING_BYTES_PER_PX);
}

/// Reserves the crops of the largest photos in work. `crops_bytes`: by the photo's pixels.
pub(super) fn reserve_crops(
    memory: &mut MemoryPlan,
    views: &[View],
    n_in_work: usize,
    crops_bytes: impl Fn(u64) -> u64,
) {
    let bytes = areas_px(views).into_iter().take(n_in_work).map(crops_bytes).sum();
    memory.reserve(Phase::Views, "crops in work", bytes);
}

pub(super) fn reserve_thumbnails(memory: &mut MemoryPlan, views: &[View], n_threads: usize) {
    let in_work_px: u64 = areas_px(views).iter().take(n_threads).sum();
    memory.reserve(Phase::Refine, "photos that thumbnails are cut from", in_work_px * PHOTO_BYTES_PER_PX);
}

/// Areas of photos, largest first.
fn areas_px(views: &[View]) -> Vec<u64> {
    let mut areas_px: Vec<u64> = views.iter().map(ingest::photo_area_px).collect();
    areas_px.sort_unstable_by(|a, b| b.cmp(a));
    areas_px
}

/// Numbers of views with a photo, and of Gaussians.
pub(crate) fn count_inputs(inputs: &InputSettings) -> Result<(usize, usize), EncodeError> {
    let scene = splat::read(&inputs.scene, &ReadOptions { with_sh_rest: false })?;
    if let Some(planned) = &inputs.planned {
        return Ok((planned.n_views, scene.len()));
    }
    let views = read_views(inputs)?.views;
    Ok((views.len() - ingest::missing_images(&views).len(), scene.len()))
}

/// Reads the poses of every nth photo, and those of further files.
fn read_views(inputs: &InputSettings) -> Result<ViewSet, EncodeError> {
    let mut set = poses::read(&inputs.views, inputs.images.as_deref())?;
    // Planned views are few, and each shows what others do not.
    let (drawn, photos): (Vec<_>, Vec<_>) =
        inputs.added.iter().partition(|path| ingest::drawn_from(path).is_some());
    photos.into_iter().try_for_each(|path| add_views(&mut set, &inputs.views, path))?;
    if let Some(n) = inputs.every {
        let n_frames = set.views.len() + set.without_pose.len();
        set = set.every(n);
        tracing::info!("every {n}th frame: {} of {n_frames}", set.views.len() + set.without_pose.len());
    }
    drawn.into_iter().try_for_each(|path| add_views(&mut set, &inputs.views, path))?;
    set.notes.iter().for_each(|note| tracing::warn!("{note}"));
    if let Some(left_out) = set.left_out() {
        tracing::info!("{left_out}");
    }
    drop_views(&mut set.views, &inputs.dropped)?;
    Ok(set)
}

/// Adds the views of another poses file. `first`: the first file, for errors.
fn add_views(set: &mut ViewSet, first: &Path, path: &Path) -> Result<(), EncodeError> {
    let added = poses::read(path, None)?;
    let (shown, first) = (path.display(), first.display());
    if added.applied != set.applied {
        return Err(EncodeError::Failed(format!(
            "{shown}: applied_transform or applied_scale differ from those of {first}; bring both poses into one frame"
        )));
    }
    let known: HashSet<&str> = set.views.iter().map(|view| view.name.as_str()).collect();
    if let Some(view) = added.views.iter().find(|view| known.contains(view.name.as_str())) {
        return Err(EncodeError::Failed(format!(
            "{shown}: view {} has a pose already in {first}; give the photos other names, or leave one of the files out",
            view.name
        )));
    }
    set.views.extend(added.views);
    set.views.sort_by(|a, b| a.name.cmp(&b.name));
    set.without_pose.extend(added.without_pose);
    set.without_pose.sort();
    set.damaged.extend(added.damaged);
    Ok(())
}

fn drop_views(views: &mut Vec<View>, names: &[String]) -> Result<(), EncodeError> {
    for name in BTreeSet::from_iter(names) {
        let Some(at) = views.iter().position(|view| view.name == *name) else {
            let first = views.first().map_or("", |view| &view.name);
            return Err(EncodeError::Failed(format!(
                "--drop {name}: no poses file has this view; its first view is {first:?}"
            )));
        };
        views.remove(at);
    }
    Ok(())
}

fn find_views(
    settings: &EncodeSettings,
    views: Vec<View>,
) -> Result<(Vec<View>, Vec<SkippedView>), EncodeError> {
    let n_views = views.len();
    let (found, gone): (Vec<View>, Vec<View>) = views.into_iter().partition(|v| v.image_path.is_file());
    let mut photos_of: BTreeMap<PathBuf, BTreeMap<OsString, PathBuf>> = BTreeMap::new();
    let mut reason_of = |path: &Path| {
        let folder = path.parent().unwrap_or(path);
        let photos = photos_of.entry(folder.to_owned()).or_insert_with(|| photos_by_stem(folder));
        let advice = match photos.get(path.file_stem().unwrap_or_default()) {
            None => "give the photos' folder with --images".to_owned(),
            Some(other) => format!(
                "{} is there: the poses must name photos as they are, and JPEG, PNG and WebP are read",
                other.display()
            ),
        };
        format!("{}: no such photo; {advice}", path.display())
    };
    if let Some(first) = gone.first().filter(|_| settings.run.strict) {
        let n = gone.len();
        let reason = reason_of(&first.image_path);
        return Err(EncodeError::Failed(format!(
            "{n} of {n_views} photos are missing, the first is {reason}"
        )));
    }
    let skip = |View { name: view, image_path, .. }: View| {
        let reason = reason_of(&image_path);
        SkippedView { view, reason }
    };
    let skipped: Vec<SkippedView> = gone.into_iter().map(skip).collect();
    if found.is_empty() {
        let reason = skipped.first().map_or("the poses file has none".into(), |s| s.reason.clone());
        return Err(EncodeError::no_views(n_views, &reason));
    }
    Ok((found, skipped))
}

/// Endings of photos that other programs read, too.
const PHOTO_ENDINGS: &str = "heic heif avif tif tiff dng bmp gif jxl jp2 jpg jpeg png webp";

/// Photos of a folder by their names without endings; of several endings, the first.
fn photos_by_stem(folder: &Path) -> BTreeMap<OsString, PathBuf> {
    let is_photo = |path: &PathBuf| {
        let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        PHOTO_ENDINGS.split(' ').any(|of| of == ending)
    };
    let files = fs_err::read_dir(folder).into_iter().flatten().filter_map(|entry| Some(entry.ok()?.path()));
    let mut photos: Vec<PathBuf> = files.filter(is_photo).collect();
    photos.sort_unstable_by(|a, b| b.cmp(a));
    photos.into_iter().map(|path| (path.file_stem().unwrap_or_default().to_owned(), path)).collect()
}

/// Version of plan and drawings; a change redraws them.
const PLAN_VERSION: u32 = 6;

/// Draws a splat's planned views beside the poses file, unless they are there.
pub(super) fn make(
    settings: &EncodeSettings,
    planned: &ViewpointSettings,
    engines: &Engines<'_>,
    context: &RunContext<'_>,
) -> Result<(), EncodeError> {
    let inputs = &settings.inputs;
    let mut scene =
        context.time("read", || splat::read(&inputs.scene, &ReadOptions { with_sh_rest: true }))?;
    inputs.activated.undo(&mut scene);
    ingest::drop_broken_harmonics(&mut scene);
    let device = engines.rasterizer.identity();
    let id = context.install(|| identity(&scene, planned, &device))?;
    let folder = inputs.views.parent().unwrap_or(Path::new("."));
    if is_there(&inputs.views, id) {
        return Ok(());
    }
    viewpoints::check_folder(folder)?;
    let make = || {
        let memory_bytes = settings.run.memory_bytes;
        viewpoints::plan(&scene, engines.rasterizer, planned, memory_bytes, context.cancel)
    };
    let plan = context.time("plan views", || context.install(make));
    let plan = plan.map_err(|error| match error {
        ViewpointError::Interrupted => EncodeError::Interrupted { n_done: 0, n_views: planned.n_views },
        other => other.into(),
    })?;
    tracing::info!("no photos: {plan}");
    let name = inputs.scene.file_name().unwrap_or_default().to_string_lossy();
    let (views, about) = (viewpoints::views_of(&plan), json!({ "plan": id.to_string() }));
    let (rasterizer, progress) = (engines.rasterizer, context.progress);
    let draw = || viewpoints::draw_sharpened(folder, &views, &mut scene, rasterizer, &name, about, progress);
    context.time("draw", || context.install(draw))?;
    Ok(())
}

fn identity(scene: &Gaussians, planned: &ViewpointSettings, device: &str) -> Result<Hash32, EncodeError> {
    let columns = hashes_of_columns(scene).map(|hash| hash.to_string());
    hash_of(&(PLAN_VERSION, env!("CARGO_PKG_VERSION"), device, planned, scene.sh_degree, columns))
}

/// Whether a poses file, which is written last, belongs to this plan.
fn is_there(poses: &Path, id: Hash32) -> bool {
    let text = fs_err::read(poses).ok();
    let found = text.and_then(|text| serde_json::from_slice::<Value>(&text).ok());
    found.is_some_and(|found| found["plan"] == id.to_string())
}

/// Version of the steps from masks to contributions; a change makes another encode.
const REGIONS_VERSION: u32 = 4;

/// Stands for a fleet's rasterisers, which differ between machines.
#[cfg(feature = "fleet")]
pub(crate) const OF_A_FLEET: &str = "fleet";

/// Everything on which the contributions of all views depend: files by their content, settings as they are.
///
/// A setting is part of it by being a field of [`ViewSettings`].
#[derive(Serialize)]
struct SceneIdentity<'a> {
    program: &'static str,
    regions: (u32, u32),
    encoder: Hash32,
    /// Windows are no part of the encoder's id: they change no vector of a crop.
    windows: &'a [u8],
    session: Session,
    segmenter: String,
    /// Devices round differently; a fleet has many.
    rasterizer: &'a str,
    scene: Hash32,
    settings: &'a ViewSettings,
    cells: CellsIdentity,
}

/// See [`CellSplit::deciding`](crate::cells::CellSplit::deciding).
type CellsIdentity = (usize, Option<f64>, Option<PositionError>);

/// How models run: other hardware and another split of the work change vectors in the last bits.
#[derive(Serialize)]
struct Session {
    providers: Vec<String>,
    n_threads: usize,
}

#[derive(Serialize)]
struct ViewIdentity<'a> {
    of_scene: Hash32,
    name: &'a str,
    /// Hash of the photo's file; absent where it cannot be read.
    photo: Option<Hash32>,
    /// Hash of its mask file; absent where it has none.
    masks: Option<Hash32>,
    intrinsics: Intrinsics,
    camera_from_world: glam::DAffine3,
}

/// Identities of the scene and, by name, of its views. A view's includes the scene's, but no other view, so photos can
/// be added and withdrawn.
pub(super) fn identities(
    settings: &EncodeSettings,
    engines: &Engines<'_>,
    segmenter: &dyn Segmenter,
    rasterizer: &str,
    inputs: &Inputs,
) -> Result<(Hash32, BTreeMap<String, Hash32>), EncodeError> {
    let cells = inputs.split.deciding(settings.cells.limits);
    let of_scene = of_scene(&settings.view, cells, engines, segmenter, rasterizer, &inputs.scene)?;
    let of_view = |view: &View| Ok((view.name.clone(), of_view(of_scene, view, segmenter)?));
    Ok((of_scene, inputs.views.par_iter().map(of_view).collect::<Result<_, EncodeError>>()?))
}

/// Hash of everything that a view's contributions depend on, from its files as they are now.
pub(super) fn of_view(
    of_scene: Hash32,
    view: &View,
    segmenter: &dyn Segmenter,
) -> Result<Hash32, EncodeError> {
    hash_of(&ViewIdentity {
        of_scene,
        name: &view.name,
        photo: ingest::hash_file(&view.image_path).ok(),
        masks: segmenter.identity_of_view(view)?,
        intrinsics: view.intrinsics,
        camera_from_world: view.camera_from_world,
    })
}

/// Hash of everything that all views' contributions depend on.
pub(crate) fn of_scene(
    settings: &ViewSettings,
    cells: CellsIdentity,
    engines: &Engines<'_>,
    segmenter: &dyn Segmenter,
    rasterizer: &str,
    scene: &Gaussians,
) -> Result<Hash32, EncodeError> {
    let Engines { models, session, .. } = engines;
    hash_of(&SceneIdentity {
        program: env!("CARGO_PKG_VERSION"),
        regions: (REGIONS_VERSION, MAX_RASTER_WIDTH_PX),
        encoder: Hash32(models.encoder_id().hash()),
        windows: models.windows(),
        session: Session {
            providers: session.providers.iter().map(ToString::to_string).collect(),
            n_threads: session.intra_op_threads,
        },
        segmenter: segmenter.identity(),
        rasterizer,
        scene: Hash32::of(&hashes_of_columns(scene).map(|hash| hash.0)[..4].concat()),
        settings,
        cells,
    })
}

fn hash_of(identity: &impl Serialize) -> Result<Hash32, EncodeError> {
    Ok(Hash32::of(&serde_json::to_vec(identity).map_err(std::io::Error::from)?))
}

/// The last two are of colours.
fn hashes_of_columns(scene: &Gaussians) -> [Hash32; 6] {
    let columns: [&[u8]; 6] = [
        bytemuck::cast_slice(&scene.means_in_world),
        bytemuck::cast_slice(&scene.rotations_wxyz),
        bytemuck::cast_slice(&scene.scales),
        bytemuck::cast_slice(&scene.opacities),
        bytemuck::cast_slice(&scene.sh_dc),
        bytemuck::cast_slice(&scene.sh_rest),
    ];
    columns.map(Hash32::of)
}

#[cfg(test)]
mod tests {

    use slag_models::{ModelDir, Provider, SessionOptions};
    use slag_test_support::assert_error;

    use super::*;
    use crate::cells::CellSplit;
    use crate::encode::Masks;
    use crate::raster::{CpuRasterizer, pinhole};
    use crate::segment::{GivenMasks, GraphSegmenter};

    #[test]
    fn a_scene_of_too_many_cells_is_refused() {
        assert!(check_cells(65_536).is_ok());
        assert_error(check_cells(65_537), &["--cell-gaussians and --cell-width-m"]);
    }

    #[test]
    fn a_photo_of_another_ending_is_found_and_no_other_file() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["a.HEIC", "a.json", "a.tif", "b.txt"] {
            fs_err::write(folder.path().join(name), "").expect("writes");
        }
        assert_eq!(photos_by_stem(folder.path()), [("a".into(), folder.path().join("a.HEIC"))].into());
    }

    /// By hand: a camera with a photo of 400 x 300 px, absent, and two of 40 x 30 by their headers. Two are in work, 19
    /// bytes a pixel; of two more that may wait there is one, 12 bytes a pixel.
    #[test]
    fn photos_are_reserved_by_their_files_in_work_and_waiting() {
        let folder = tempfile::tempdir().expect("a folder");
        let view = |name: &str| View {
            name: name.into(),
            image_path: folder.path().join(name),
            intrinsics: crate::raster::pinhole([400, 300], 300.0),
            camera_from_world: glam::DAffine3::IDENTITY,
        };
        for name in ["a.png", "c.png"] {
            image::RgbImage::new(40, 30).save(folder.path().join(name)).expect("it is writable");
        }
        let mut memory = MemoryPlan::new(0);
        reserve_photos(&mut memory, &["a.png", "b.png", "c.png"].map(view), 2, 4);
        let refused = memory.rest(0).expect_err("nothing fits");
        assert_eq!(refused.needed_bytes, 19 * (400 * 300 + 40 * 30) + 12 * 40 * 30);
    }

    fn inputs(photo: &Path) -> Inputs {
        let view = View {
            name: "a.png".into(),
            image_path: photo.to_owned(),
            intrinsics: pinhole([8, 8], 8.0),
            camera_from_world: glam::DAffine3::IDENTITY,
        };
        Inputs {
            scene: Gaussians::default(),
            split: CellSplit::default(),
            standing: std::sync::Arc::default(),
            views: vec![view],
            missing: Vec::new(),
            geo_reference: None,
        }
    }

    fn identity_with(
        change: impl FnOnce(&mut EncodeSettings, &mut SessionOptions),
        segmenter: &dyn Segmenter,
        photo: &Path,
    ) -> Hash32 {
        let mut settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        settings.view.masks = Masks::Graph;
        let mut session = SessionOptions::new(PathBuf::new());
        change(&mut settings, &mut session);
        let models = ModelDir::colours();
        let engines = Engines::new(&models, &session, &CpuRasterizer);
        identities(&settings, &engines, segmenter, "cpu", &inputs(photo)).expect("readable").1["a.png"]
    }

    /// Views of two devices, or of a fleet, must not mix in one store.
    #[test]
    fn the_device_that_rasterises_counts() {
        let settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        let (models, session) = (ModelDir::colours(), SessionOptions::new(PathBuf::new()));
        let engines = Engines::new(&models, &session, &CpuRasterizer);
        let of = |device: &str| {
            let (graph, inputs) = (GraphSegmenter::default(), inputs(Path::new("absent.png")));
            identities(&settings, &engines, &graph, device, &inputs).expect("readable").0
        };
        assert!(of("cpu") != of("NVIDIA H100 F64") && of("cpu") != of(OF_A_FLEET) && of("cpu") == of("cpu"));
    }

    /// Files of equal path and length differ by content; so do masks in a single COCO file.
    #[test]
    fn photos_and_masks_count_by_content() {
        let dir = tempfile::tempdir().expect("a folder");
        let photo = dir.path().join("a.png");
        let (graph, mut found) = (GraphSegmenter::default(), Vec::new());
        for content in ["one", "two", "one"] {
            fs_err::write(&photo, content).expect("writes");
            found.push(identity_with(|_, _| {}, &graph, &photo));
        }
        assert!(found[0] == found[2] && found[0] != found[1], "photos");

        let (file, folder) = (dir.path().join("masks.json"), dir.path().join("masks"));
        fs_err::create_dir_all(&folder).expect("makes");
        for (path, given) in [(&file, &file), (&folder.join("a.json"), &folder)] {
            found.clear();
            for counts in ["[4,60]", "[5,59]", "[4,60]"] {
                let annotation =
                    format!(r#"{{"image_id": 1, "segmentation": {{"size": [8, 8], "counts": {counts}}}}}"#);
                let images = r#"[{"id": 1, "file_name": "a.png"}]"#;
                let text = format!(r#"{{"images": {images}, "annotations": [{annotation}]}}"#);
                fs_err::write(path, text).expect("writes");
                let masks = GivenMasks::open(given, Vec::new()).expect("opens");
                found.push(identity_with(|_, _| {}, &masks, &photo));
            }
            assert!(found[0] == found[2] && found[0] != found[1], "{}", given.display());
        }
    }

    #[test]
    fn the_execution_provider_and_every_view_setting_count() {
        let (graph, photo) = (GraphSegmenter::default(), Path::new("absent.png"));
        let with = |change: &dyn Fn(&mut EncodeSettings, &mut SessionOptions)| {
            identity_with(|settings, session| change(settings, session), &graph, photo)
        };
        let plain = with(&|_, _| {});
        let changed = [
            with(&|_, session| session.providers = vec![Provider::Cuda]),
            with(&|settings, _| settings.view.min_mask_px += 1),
            with(&|settings, _| settings.view.masks = Masks::Auto { n_levels: 2 }),
            with(&|settings, _| settings.cells.limits.max_gaussians -= 1),
        ];
        assert!(changed.iter().all(|identity| *identity != plain));
        // Later steps are no part of the identity.
        assert_eq!(with(&|settings, _| settings.aggregation = crate::lift::Aggregation::default()), plain);
    }
}
