//! The settings of an encode, split by the step that reads them.

use std::num::NonZeroU32;
use std::path::PathBuf;
use std::time::Duration;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use slag_common::shard::Profile;

use super::error::EncodeError;
use crate::cells::{CellLimits, PositionError};
use crate::codebook::basis::MAX_COMPONENTS;
use crate::ingest::{Activated, FrameChoice};
use crate::lift::Aggregation;
use crate::occupancy::OccupancySettings;
use crate::segment::SamSettings;
use crate::shard::ShardSettings;
use crate::viewpoints::ViewpointSettings;

/// Scales of the built-in segmenter by default. A fourth gives a third more masks and no better answers (generated
/// scenes of seeds 601 to 605, and the labelled house).
pub const DEFAULT_MASK_LEVELS: usize = 3;
/// Widest raster by default: masks are coarser than this, and time grows with the square.
pub(crate) const MAX_RASTER_WIDTH_PX: u32 = 1024;
/// Shards number a cell's Gaussians with 16 bits.
pub(crate) const MAX_CELL_GAUSSIANS: usize = 65_536;
pub(crate) const DEFAULT_CELL_WIDTH_M: f64 = 25.0;

#[derive(Clone, Debug)]
pub struct EncodeSettings {
    pub inputs: InputSettings,
    /// How a view becomes contributions. A change of any of these is another encode.
    pub view: ViewSettings,
    /// How contributions become embeddings. Finished views stay valid when it changes.
    pub aggregation: Aggregation,
    pub cells: CellSettings,
    pub output: OutputSettings,
    /// How the run goes: none of it changes what is made of a given set of views.
    pub run: RunSettings,
}

#[derive(Clone, Debug, Default)]
pub struct InputSettings {
    pub scene: PathBuf,
    /// The poses: a COLMAP model, a transforms.json or a ScanNet scene folder.
    pub views: PathBuf,
    /// How views are planned that have no photos; they are drawn, and kept with their poses at `views`.
    pub planned: Option<ViewpointSettings>,
    /// The photos' folder, where it is not beside the poses.
    pub images: Option<PathBuf>,
    /// Poses of further photos in the same world, which lie where these files say.
    pub added: Vec<PathBuf>,
    pub dropped: Vec<String>,
    /// Every how many frames one is taken, by their numbers; all where absent.
    pub every: Option<NonZeroU32>,
    /// What states the splat's frame against that of the poses.
    pub splat_frame: FrameChoice,
    /// What the splat file has in place of logarithms and logits.
    pub activated: Activated,
    /// Whether a world unit is a metre; a geo-reference implies it.
    pub metric: bool,
    pub geo: Option<PathBuf>,
}

/// How a view becomes contributions: all of it is part of the encode's identity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewSettings {
    pub masks: Masks,
    /// Masks with fewer pixels are left out, but for those of what stands on the ground.
    pub min_mask_px: u32,
    /// Width at which weights are rasterised.
    pub(crate) raster_width: RasterWidth,
    /// Whether slivers between masks join their neighbours.
    pub(crate) merges_slivers: bool,
    #[serde(default, skip_serializing_if = "Regions::are_masks")]
    pub regions: Regions,
}

/// Which parts of a photo have vectors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Regions {
    /// Masks: by a crop each and, where the image model has patches that are aligned with text, by the patches
    /// within them; else, where the model wants them, by windows over the photo.
    #[default]
    Masks,
    /// Masks, by a crop each.
    Crops,
    /// Patches of the image model: neither masks nor crops.
    Patches,
}

impl Regions {
    fn are_masks(&self) -> bool {
        *self == Self::Masks
    }

    pub(crate) fn have_masks(self) -> bool {
        self != Self::Patches
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Masks {
    /// From the built-in segmenter with the embedded model.
    Auto {
        /// Number of scales at which it looks, coarsest first.
        n_levels: usize,
    },
    /// From the built-in segmenter without a model.
    Graph,
    /// From files that the user gives.
    Given {
        /// Their folder, or a COCO file. The identity has the files' contents instead.
        #[serde(skip)]
        dir: PathBuf,
        /// Ids of label images that are no masks (a "nothing" value such as 255).
        ignore_ids: Vec<u32>,
    },
    /// From Segment Anything.
    Sam {
        /// The model directory. The identity has the files' hashes instead.
        #[serde(skip)]
        dir: PathBuf,
        settings: SamSettings,
        /// Threads within a run of the model; another number may change logits in the last bits.
        n_model_threads: usize,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum RasterWidth {
    /// The photo's own width, at most `MAX_RASTER_WIDTH_PX`.
    Photo,
    Px(u32),
}

impl RasterWidth {
    pub(crate) fn px(self, photo_px: u32) -> u32 {
        match self {
            Self::Px(width_px) => width_px,
            Self::Photo => photo_px.min(MAX_RASTER_WIDTH_PX),
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct CellSettings {
    pub limits: CellLimits,
    pub shards: ShardSettings,
    /// Whether masks that views agree on become objects.
    pub objects: bool,
    /// How free and occupied places are told apart, if shards have them.
    pub occupancy: Option<OccupancySettings>,
    /// Whether shards say where the photos of their cells were taken.
    pub photo_poses: bool,
    /// Whether shards have landmarks, by which robots find the cameras of their photos.
    pub landmarks: bool,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct OutputSettings {
    pub store: PathBuf,
    pub scene_name: String,
    /// When it is made, seconds since 1970.
    pub created_unix_secs: u64,
    /// Name or folder of the models, as later queries on this machine open them; `None` for the embedded ones.
    pub models: Option<PathBuf>,
    pub text_model: bool,
}

/// Which kept views of an encode are dropped before this one begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Restart {
    /// None: an unfinished encode of another splat or with other settings is refused.
    Never,
    /// Those of another splat or of other settings.
    IfOther,
    Always,
}

#[derive(Clone, Debug, PartialEq)]
pub struct RunSettings {
    /// Worker threads, and views worked on at a time.
    pub threads: usize,
    /// Working memory; [`MemoryPlan`](crate::memory::MemoryPlan) says what it covers.
    pub memory_bytes: u64,
    /// Views used at most: the first ones of the order.
    pub views_limit: ViewsLimit,
    pub view_order: ViewOrder,
    /// Time from the start after which no view is begun; at least one view is used.
    pub(crate) time_budget: Option<Duration>,
    /// Whether a missing or unreadable input ends the encode.
    pub strict: bool,
    /// Publishes a generation in which no Gaussian has an embedding.
    pub(crate) allow_empty: bool,
    pub restart: Restart,
    /// Whether the views' contributions are kept after publication, for an encode with another aggregation.
    pub keep_views: bool,
    /// The NVIDIA GPUs that share the work of models, as CUDA numbers them, at least one; without an NVIDIA
    /// provider they mean nothing.
    pub gpus: Vec<u32>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ViewsLimit {
    All,
    Count(usize),
    /// This share of them, 0 to 1.
    Share(f64),
}

impl ViewsLimit {
    /// Returns the limit for `n` views, at least one.
    pub fn of(self, n: usize) -> usize {
        match self {
            Self::All => n,
            Self::Count(count) => count.clamp(1, n),
            Self::Share(share) => ((share * n as f64).round() as usize).clamp(1, n),
        }
    }
}

/// The order in which views are taken; it matters where not all of them are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum ViewOrder {
    /// Those first that together show most of the scene, by a small raster of all views.
    Coverage,
    /// By their names.
    Names,
    /// Evenly spread over the names.
    Nth,
}

impl EncodeSettings {
    /// Returns the settings to encode a splat and its photos into a store: those of the program without flags, and
    /// of [`Preset::Balanced`](super::Preset::Balanced).
    pub fn new(scene: PathBuf, views: PathBuf, store: PathBuf, metric: bool) -> Self {
        Self {
            inputs: InputSettings { scene, views, metric, ..InputSettings::default() },
            view: ViewSettings {
                masks: Masks::Auto { n_levels: DEFAULT_MASK_LEVELS },
                min_mask_px: 50,
                raster_width: RasterWidth::Photo,
                merges_slivers: true,
                regions: Regions::Masks,
            },
            aggregation: Aggregation::REFINED,
            cells: CellSettings {
                limits: CellLimits {
                    max_gaussians: MAX_CELL_GAUSSIANS,
                    max_width: metric.then_some(DEFAULT_CELL_WIDTH_M),
                    position_error: PositionError::default_for(metric),
                },
                shards: ShardSettings { profiles: Profile::ALL.to_vec(), ..ShardSettings::default() },
                objects: true,
                occupancy: None,
                photo_poses: false,
                landmarks: false,
            },
            output: OutputSettings { store, scene_name: "scene".into(), ..OutputSettings::default() },
            run: RunSettings {
                threads: std::thread::available_parallelism().map_or(1, usize::from),
                memory_bytes: 2 << 30,
                views_limit: ViewsLimit::All,
                view_order: ViewOrder::Names,
                time_budget: None,
                strict: false,
                allow_empty: false,
                restart: Restart::Never,
                keep_views: false,
                gpus: vec![0],
            },
        }
    }

    pub(crate) fn validate(&self) -> Result<(), EncodeError> {
        let Self { view, aggregation, cells, run, .. } = self;
        let (limits, codebook) = (&cells.limits, &cells.shards.codebook);
        let is_positive = |x: f64| x > 0.0 && x.is_finite();
        let is_error = |x: f32| x >= 0.0 && x.is_finite();
        let is_even = |n: usize| n >= 2 && n.is_multiple_of(2);
        let is_metric = self.inputs.metric || self.inputs.geo.is_some();
        let has_share = !matches!(run.views_limit, ViewsLimit::Share(share) if !(0.0..=1.0).contains(&share));
        let has_levels = !matches!(view.masks, Masks::Auto { n_levels } if !(1..=4).contains(&n_levels));
        let has_width = !matches!(view.raster_width, RasterWidth::Px(px) if !(16..=8192).contains(&px));
        let has_gaussians = (1..=MAX_CELL_GAUSSIANS).contains(&limits.max_gaussians);
        let has_components = is_even(codebook.max_components) && codebook.max_components <= MAX_COMPONENTS;
        let has_error = !matches!(limits.position_error, PositionError::Within(error) if !is_positive(error));
        let has_voxels = cells.occupancy.is_none_or(|of| (0.02..=0.5).contains(&of.voxel_m));
        let checks = [
            ("--threads", run.threads > 0, "0 threads; expected at least 1"),
            ("--gpus", !run.gpus.is_empty(), "none; expected at least one number"),
            ("--views-limit", has_share, "expected a share of 0 to 1"),
            ("--mask-levels", has_levels, "expected 1 to 4 levels"),
            ("--raster-width", has_width, "expected 16 to 8192 pixels"),
            ("--cell-gaussians", has_gaussians, "expected 1 to 65536 Gaussians a cell"),
            ("--cell-width-m", limits.max_width.is_none_or(is_positive), "expected a finite width above 0"),
            ("--profiles", !cells.shards.profiles.is_empty(), "expected at least one profile"),
            (
                "--max-components",
                has_components,
                "expected an even number of components, 2 to 128: subspaces come in pairs",
            ),
            (
                "max_subspaces",
                is_even(codebook.max_subspaces),
                "expected an even number of subspaces, at least 2: two share a byte",
            ),
            ("--compact-error", is_error(codebook.compact_error), "expected a finite error, at least 0"),
            ("balanced_error", is_error(codebook.balanced_error), "expected a finite error, at least 0"),
            ("--occupancy", has_voxels, "expected voxels of 0.02 to 0.5 metres"),
            (
                "--occupancy",
                cells.occupancy.is_none() || is_metric,
                "a robot's size is in metres, the scene's units are not known to be; give --metric if they are metres",
            ),
            ("--min-view-share", aggregation.min_view_share <= 1.0, "expected a share of 0 to 1"),
            ("--position-error", has_error, "expected a finite error above 0"),
        ];
        let refuse = |setting: &str, problem: &str| {
            Err(EncodeError::Setting { setting: setting.into(), problem: problem.into() })
        };
        if let Some((setting, _, problem)) = checks.into_iter().find(|(_, is_valid, _)| !is_valid) {
            return refuse(setting, problem);
        }
        // By their serialised form, so that a new field is checked too.
        let fields = serde_json::to_value(aggregation).map_err(std::io::Error::from)?;
        for (field, value) in fields.as_object().into_iter().flatten() {
            // NaN and infinity are no JSON numbers.
            let is_valid = value.is_boolean() || value.as_f64().is_some_and(|x| (0.0..=1000.0).contains(&x));
            if !is_valid {
                return refuse(&format!("--{}", field.replace('_', "-")), "expected 0 to 1000");
            }
        }
        Ok(())
    }
}

/// A bundle of choices. `slag-lab bench tradeoff` measures the cost and quality of each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// The paper's own settings: SAM on a grid of 16 x 16 points with LangSplat's filters, whole masks alone,
    /// uncleaned; white behind the masks, rasters 648 pixels wide, the plain average, no objects. Without
    /// `--segmenter` the built-in segmenter stands in for SAM, with its coarsest masks.
    Paper,
    /// The paper's method with the masks of `balanced`: rasters as wide as photos, the plain average, no objects.
    Plain,
    /// Half of the views, by coverage; two scales of masks, by their crops alone; coarse rasters; refined
    /// contributions.
    Fast,
    /// All views; refined contributions.
    #[default]
    Balanced,
}

impl Preset {
    /// Applies the preset to default settings, which are those of [`Self::Balanced`].
    pub fn apply(self, settings: &mut EncodeSettings) {
        let EncodeSettings { view, aggregation, cells, run, .. } = settings;
        match self {
            Self::Balanced => {}
            Self::Plain => {
                view.regions = Regions::Crops;
                *aggregation = Aggregation::default();
                cells.objects = false;
            }
            // Section "Settings" of the paper (IEEE RA-L 2025): grid 16, whole level, ScanNet's raster of 648 x 484.
            Self::Paper => {
                view.masks = Masks::Auto { n_levels: 1 };
                view.regions = Regions::Crops;
                view.min_mask_px = 1;
                view.merges_slivers = false;
                view.raster_width = RasterWidth::Px(648);
                *aggregation = Aggregation::default();
                cells.objects = false;
            }
            Self::Fast => {
                view.masks = Masks::Auto { n_levels: 2 };
                view.regions = Regions::Crops;
                view.raster_width = RasterWidth::Px(320);
                run.views_limit = ViewsLimit::Share(0.5);
            }
        }
    }

    /// Settings of Segment Anything, for encodes that use it.
    pub fn sam(self) -> SamSettings {
        match self {
            Self::Paper => SamSettings::paper(),
            _ => SamSettings::default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::segment::{SamLevels, ScoreFilter};

    #[test]
    fn settings_out_of_range_name_their_flag() {
        let refused = |change: &dyn Fn(&mut EncodeSettings)| {
            let mut settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
            settings.validate().expect("the default is valid");
            change(&mut settings);
            match settings.validate() {
                Err(EncodeError::Setting { setting, .. }) => setting,
                other => panic!("{other:?}"),
            }
        };
        type Change = fn(&mut EncodeSettings);
        let rows: [(&str, Change); 19] = [
            ("--threads", |s| s.run.threads = 0),
            ("--views-limit", |s| s.run.views_limit = ViewsLimit::Share(f64::NAN)),
            ("--mask-levels", |s| s.view.masks = Masks::Auto { n_levels: 0 }),
            ("--raster-width", |s| s.view.raster_width = RasterWidth::Px(0)),
            ("--cell-gaussians", |s| s.cells.limits.max_gaussians = 0),
            ("--cell-width-m", |s| s.cells.limits.max_width = Some(0.0)),
            ("--profiles", |s| s.cells.shards.profiles.clear()),
            ("--max-components", |s| s.cells.shards.codebook.max_components = 0),
            ("--max-components", |s| s.cells.shards.codebook.max_components = 7),
            ("--max-components", |s| s.cells.shards.codebook.max_components = 130),
            ("max_subspaces", |s| s.cells.shards.codebook.max_subspaces = 0),
            ("max_subspaces", |s| s.cells.shards.codebook.max_subspaces = 3),
            ("--compact-error", |s| s.cells.shards.codebook.compact_error = -0.1),
            ("balanced_error", |s| s.cells.shards.codebook.balanced_error = f32::NAN),
            ("--position-error", |s| s.cells.limits.position_error = PositionError::Within(0.0)),
            ("--occupancy", |s| s.cells.occupancy = Some(OccupancySettings { voxel_m: 0.0 })),
            ("--occupancy", |s| {
                s.inputs.metric = false;
                s.cells.occupancy = Some(OccupancySettings { voxel_m: 0.05 });
            }),
            ("--superpoint", |s| s.aggregation.superpoint = f32::INFINITY),
            ("--min-view-share", |s| s.aggregation.min_view_share = 1.5),
        ];
        for (flag, change) in rows {
            assert_eq!(refused(&change), flag);
        }
    }

    fn settings(preset: Preset) -> EncodeSettings {
        let mut settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        preset.apply(&mut settings);
        settings
    }

    /// Oracle: the paper's text and LangSplat's `preprocess.py`, copied by hand.
    #[test]
    fn paper_has_the_papers_settings() {
        let paper = settings(Preset::Paper);
        let view = &paper.view;
        assert_eq!((view.regions, paper.aggregation), (Regions::Crops, Aggregation::default()));
        let found = (paper.cells.objects, view.min_mask_px, view.merges_slivers, view.raster_width);
        assert_eq!(found, (false, 1, false, RasterWidth::Px(648)));
        let sam = Preset::Paper.sam();
        assert_eq!((sam.points_per_side, sam.levels), (16, SamLevels::Whole));
        assert_eq!((sam.predicted_iou, sam.stability, sam.stability_offset), (0.7, 0.85, 1.0));
        assert_eq!((sam.crop_layers, sam.crop_points_divisor, sam.min_region_px), (1, 1, 100));
        assert_eq!((sam.box_nms_iou, sam.crop_nms_iou, sam.mask_nms_iou), (0.7, 0.7, 1.0));
        let langsplat = ScoreFilter { min_score: 0.7, max_iou: 0.8, max_contained: 0.5 };
        assert_eq!(sam.score_filter, Some(langsplat));
    }
}
