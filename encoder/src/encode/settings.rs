//! What an encode is told, and the fingerprint by which an interrupted one is recognised.

use std::path::PathBuf;
use std::time::Duration;

use serde::Serialize;
use slag_common::shard::Profile;
use slag_common::{Gaussians, Hash32, View};
use slag_models::ModelDir;

use super::EncodeError;
use crate::cells::CellLimits;
use crate::codebook::CodebookSettings;
use crate::embed::Background;
use crate::lift::Aggregation;
use crate::raster::WeightKind;
use crate::segment::SamSettings;
use crate::segment::noise::MaskNoise;
use crate::shard::ShardSettings;
use crate::shard::positions::PositionError;

/// Where masks come from.
#[derive(Clone, Debug, PartialEq)]
pub enum Masks {
    /// From the built-in segmenter with the embedded model.
    Auto {
        /// Scales at which it looks, coarsest first.
        n_levels: usize,
    },
    /// From the built-in segmenter without a model.
    Graph,
    /// From files that the user gives.
    Given {
        /// Their folder.
        dir: PathBuf,
        /// Ids of label images that are no masks (a "nothing" value such as 255).
        ignore_ids: Vec<u32>,
    },
    /// From Segment Anything.
    Sam {
        /// The model directory.
        dir: PathBuf,
        /// How many masks.
        settings: SamSettings,
        /// Threads within a run of the model. Another number may change masks in the last bits of their logits.
        n_model_threads: usize,
    },
}

/// Scales at which the built-in segmenter looks unless asked: with a fourth there are a third more masks, and answers
/// are no better (generated scenes of seeds 601 to 605, and the labelled house).
pub const DEFAULT_MASK_LEVELS: usize = 3;

/// How many views are used at most.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ViewsLimit {
    /// All that there are.
    All,
    /// This many.
    Count(usize),
    /// This part of those that there are, 0..=1.
    Share(f64),
}

impl ViewsLimit {
    /// Returns how many of `n` views that is, at least one.
    pub fn of(self, n: usize) -> usize {
        match self {
            Self::All => n,
            Self::Count(count) => count.clamp(1, n),
            Self::Share(share) => ((share * n as f64).round() as usize).clamp(1, n),
        }
    }
}

/// The order in which views are taken; it matters where not all of them are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ViewOrder {
    /// By their names.
    Names,
    /// Evenly spread over the names, which mostly is the order in which they were taken.
    Nth,
    /// Those first that together show most of the scene; see [`super::coverage`].
    Coverage,
}

/// What to encode and how.
#[derive(Clone, Debug)]
pub struct EncodeSettings {
    /// The splat file.
    pub scene: PathBuf,
    /// The poses: a COLMAP model or a transforms.json.
    pub views: PathBuf,
    /// The photos' folder, where it is not beside the poses.
    pub images: Option<PathBuf>,
    /// Where masks come from.
    pub masks: Masks,
    /// The store to publish into.
    pub store: PathBuf,
    /// Name of the scene.
    pub scene_name: String,
    /// Whether a world unit is a metre; a geo-reference says so too.
    pub metric: bool,
    /// A geo-reference file.
    pub geo: Option<PathBuf>,
    /// Views to use at most: the first ones of the order.
    pub views_limit: ViewsLimit,
    /// The order in which views are taken. What is made of a given set of views does not depend on it.
    pub view_order: ViewOrder,
    /// Time after which no view is begun, from the start; at least one view is used.
    pub time_budget: Option<Duration>,
    /// Width at which weights are rasterised.
    pub raster_width: RasterWidth,
    /// What fills a crop outside its mask.
    pub background: Background,
    /// Masks with fewer pixels are left out.
    pub min_mask_px: u32,
    /// Which weight is summed.
    pub weights: WeightKind,
    /// How contributions become embeddings. No part of what a view leaves behind: views that are done stay so.
    pub aggregation: Aggregation,
    /// Errors to lay over the masks, for experiments.
    pub mask_noise: Option<MaskNoise>,
    /// Whether what the views left behind is kept, for another encode of the same with another aggregation.
    pub keep_views: bool,
    /// Views worked on at a time.
    pub threads: usize,
    /// Working memory for contributions and region vectors.
    pub memory_bytes: u64,
    /// Whether a missing or unreadable input ends the encode.
    pub strict: bool,
    /// Whether an unfinished encode of other settings is dropped.
    pub restart: bool,
    /// How large a cell may become.
    pub cells: CellLimits,
    /// How fine shards are.
    pub shards: ShardSettings,
    /// Whether masks that views agree on become objects.
    pub objects: bool,
    /// Creation time to sign, seconds since 1970.
    pub created_unix_secs: u64,
    /// Expiry to sign.
    pub expires_unix_secs: Option<u64>,
}

/// Width of the rasters of views.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum RasterWidth {
    /// As [`Self::Photo`], and twice as much in views whose regions have [`LONG_BORDERS`].
    ByContent,
    /// The photo's own, at most [`MAX_RASTER_WIDTH_PX`].
    Photo,
    /// This many pixels.
    Px(u32),
}

/// Widest raster where regions do not ask for more: masks are coarser than this, and time grows with the square.
pub const MAX_RASTER_WIDTH_PX: u32 = 1024;
/// Length of the borders of a view's regions over their area, in pixels of the raster, above which it has twice the
/// width. The raster blurs Gaussians by half a pixel, and what they lose to the regions beside their own goes with
/// this. Measured on generated scenes: mIoU 0.01 to 0.03 higher for a sixth more time. Half the width where borders
/// are short was no faster on the labelled house, and a little worse.
pub const LONG_BORDERS: f64 = 0.04;
/// How masks become regions, and what is kept of them; another number is another encode.
const REGIONS_VERSION: u32 = 3;

impl EncodeSettings {
    /// Returns the settings to encode a splat and its photos into a store, as the program has them without flags.
    pub fn new(scene: PathBuf, views: PathBuf, store: PathBuf, metric: bool) -> Self {
        Self {
            scene,
            views,
            images: None,
            masks: Masks::Auto { n_levels: DEFAULT_MASK_LEVELS },
            store,
            scene_name: "scene".into(),
            metric,
            geo: None,
            views_limit: ViewsLimit::All,
            view_order: ViewOrder::Names,
            time_budget: None,
            raster_width: RasterWidth::ByContent,
            background: Background::White,
            min_mask_px: 200,
            weights: WeightKind::Blend,
            aggregation: Aggregation::REFINED,
            mask_noise: None,
            keep_views: false,
            threads: rayon::current_num_threads(),
            memory_bytes: 2 << 30,
            strict: false,
            restart: false,
            cells: CellLimits { max_gaussians: 65_536, max_width: metric.then_some(25.0) },
            shards: ShardSettings {
                profiles: Profile::ALL.to_vec(),
                codebook: CodebookSettings::default(),
                position_error: PositionError::default_for(metric),
            },
            objects: true,
            created_unix_secs: 0,
            expires_unix_secs: None,
        }
    }

    /// Returns names and lengths of the files in the given masks' folder and its subfolders.
    fn mask_files(&self) -> Result<Vec<(String, u64)>, EncodeError> {
        let Masks::Given { dir, .. } = &self.masks else { return Ok(Vec::new()) };
        let mut files = Vec::new();
        let mut folders = if dir.is_dir() { vec![dir.clone()] } else { Vec::new() };
        while let Some(folder) = folders.pop() {
            for entry in fs_err::read_dir(folder)? {
                let entry = entry?;
                match entry.metadata()? {
                    metadata if metadata.is_dir() => folders.push(entry.path()),
                    metadata => files.push((entry.path().display().to_string(), metadata.len())),
                }
            }
        }
        files.sort();
        Ok(files)
    }

    /// Returns the hash of everything on which a view's contributions depend.
    pub(super) fn fingerprint(
        &self,
        models: &ModelDir,
        segmenter: &str,
        scene: &Gaussians,
        views: &[View],
    ) -> Result<Hash32, EncodeError> {
        #[derive(Serialize)]
        struct Inputs<'a> {
            program: &'a str,
            encoder_id: Hash32,
            scene: Hash32,
            segmenter: &'a str,
            mask_files: Vec<(String, u64)>,
            views: Vec<(&'a str, u64, String)>,
            raster_width: RasterWidth,
            regions: (u32, f64),
            background: String,
            min_mask_px: u32,
            weights: String,
            cells: String,
        }
        let columns: [&[u8]; 4] = [
            bytemuck::cast_slice(&scene.means_in_world),
            bytemuck::cast_slice(&scene.rotations_wxyz),
            bytemuck::cast_slice(&scene.scales),
            bytemuck::cast_slice(&scene.opacities),
        ];
        let scene = columns.map(|column| Hash32::of(column).0).concat();
        let views = views
            .iter()
            .map(|view| {
                let len_bytes = fs_err::metadata(&view.image_path).map(|m| m.len()).unwrap_or(0);
                (view.name.as_str(), len_bytes, format!("{:?} {:?}", view.intrinsics, view.camera_from_world))
            })
            .collect();
        let inputs = Inputs {
            program: env!("CARGO_PKG_VERSION"),
            encoder_id: Hash32(models.encoder_id().hash()),
            scene: Hash32::of(&scene),
            segmenter,
            mask_files: self.mask_files()?,
            views,
            raster_width: self.raster_width,
            regions: (REGIONS_VERSION, LONG_BORDERS),
            background: format!("{:?}", self.background),
            min_mask_px: self.min_mask_px,
            weights: format!("{:?}", self.weights),
            cells: format!("{:?}", self.cells),
        };
        Ok(Hash32::of(&serde_json::to_vec(&inputs).map_err(std::io::Error::from)?))
    }
}
