//! `eval masks`: judges segmenters without words. On labelled photos by the best mask of each labelled segment; on
//! all photos by the share of the scene that masks cover.

mod segments;

use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::Serialize;
use slag_common::splat::{self, ReadOptions};
use slag_common::{View, poses};
use slag_encoder::cli::common::session_options;
use slag_encoder::encode::DEFAULT_MASK_LEVELS;
use slag_encoder::ingest;
use slag_encoder::masks::{Mask, NO_REGION, regions};
use slag_encoder::progress::Progress;
use slag_encoder::raster::devices::{DeviceChoice, Devices};
use slag_encoder::raster::gpu::GpuOptions;
use slag_encoder::raster::{LoadedScene, RasterView, Rasterizer};
use slag_encoder::segment::{
    GraphSegmenter, GraphSettings, SamSegmenter, SamSettings, SegmentInput, Segmenter,
};
use slag_models::SessionOptions;
use slag_models::commands::RunArgs;

use super::metrics::mean;
use super::truth::read_things;
use crate::scenes::SceneFiles;
use crate::table::{Table, figure, percent};
use segments::{Ious, MIN_PX};

/// Opacity from which a pixel has splat behind it.
const MIN_COVERAGE: f32 = 0.5;

/// `eval masks`.
#[derive(Debug, Args)]
pub(crate) struct MasksArgs {
    /// Scenes: a splat, poses and photos; gt/masks and gt/instances.json where there are labels.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    scene: Vec<PathBuf>,
    /// Segmenters: auto (the built-in one), graph (it without its model), or the folder of a Segment Anything
    /// model.
    #[arg(long, value_name = "auto|graph|DIR,...", value_delimiter = ',', default_value = "auto")]
    segmenter: Vec<PathBuf>,
    /// Most photos of a scene, evenly spread [default: all].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    views_limit: Option<u32>,
    /// Device that draws the scene: auto (GPUs, else the CPU), gpu, cpu, or numbers of adapters.
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceChoice,
    #[command(flatten)]
    how: RunArgs,
}

#[derive(Clone, Debug, Default, Serialize)]
struct Row {
    scene: String,
    segmenter: String,
    n_photos: usize,
    n_masks: usize,
    n_photos_without: usize,
    /// Pixels with splat behind them, and those of them in a mask.
    n_seen_px: u64,
    n_covered_px: u64,
    /// How well the masks find labelled things; absent without labels.
    things: Option<Ious>,
    /// Seconds of the segmenter a photo.
    secs: f64,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct MasksReport {
    rows: Vec<Row>,
}

pub(crate) fn run(args: &MasksArgs, progress: &dyn Progress) -> Result<MasksReport> {
    let session = session_options(&args.how)?;
    let devices = Devices::open(&args.device, GpuOptions::default())?;
    let mut rows = Vec::new();
    for files in SceneFiles::find_all(&args.scene)? {
        let gaussians = splat::read(&files.splat, &ReadOptions { with_sh_rest: false })?;
        let scene = devices.load(&gaussians)?;
        let all = poses::read(&files.poses, files.images.as_deref())?.views;
        let n = args.views_limit.map_or(all.len(), |limit| all.len().min(limit as usize));
        for name in &args.segmenter {
            let segmenter = open(name, &session)?;
            progress.begin(&format!("{} {}", files.name, name.display()), "photo", n as u64, 0);
            let mut row = Row::new(&files, name);
            let labels = match &files.true_masks {
                Some(masks) => {
                    let (things, _) = read_things(&files.dir)?;
                    Some(Labels { masks, things: things.iter().map(|thing| thing.id).collect() })
                }
                None => None,
            };
            for view in (0..n).map(|i| &all[i * all.len() / n]) {
                let of_view = || format!("{}: {}", files.dir.display(), view.name);
                row.add(view, scene.as_ref(), segmenter.as_ref(), labels.as_ref()).with_context(of_view)?;
                progress.advance(1);
            }
            row.secs /= n.max(1) as f64;
            rows.push(row);
            progress.end();
        }
    }
    Ok(MasksReport { rows })
}

fn open(name: &Path, session: &SessionOptions) -> Result<Box<dyn Segmenter>> {
    Ok(match name.to_str() {
        Some("auto") => {
            Box::new(GraphSegmenter::learnt(GraphSettings::learnt(DEFAULT_MASK_LEVELS), session, &[0])?)
        }
        Some("graph") => Box::new(GraphSegmenter::default()),
        _ => Box::new(SamSegmenter::open(name, SamSettings::default(), session, &[0])?),
    })
}

/// The ids of a scene's labels, and the folder of their pictures.
struct Labels<'a> {
    masks: &'a Path,
    things: BTreeSet<u16>,
}

impl Row {
    fn new(files: &SceneFiles, segmenter: &Path) -> Self {
        let segmenter = segmenter.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let things = files.true_masks.is_some().then(Ious::default);
        Self { scene: files.name.clone(), segmenter, things, ..Self::default() }
    }

    fn add(
        &mut self,
        view: &View,
        scene: &dyn LoadedScene,
        segmenter: &dyn Segmenter,
        labels: Option<&Labels<'_>>,
    ) -> Result<()> {
        let loaded = ingest::load_image(view)?;
        let drawing = scene.draw(&RasterView::of(&loaded.view), [0.0; 3])?;
        let depth = drawing.depth.iter().zip(&drawing.coverage);
        let depth: Vec<f32> =
            depth.map(|(depth, share)| if *share > MIN_COVERAGE { *depth } else { 0.0 }).collect();
        let start = Instant::now();
        let mut masks: Vec<Mask> = segmenter.segment(&SegmentInput::new(&loaded, Some(&depth[..])))?;
        self.secs += start.elapsed().as_secs_f64();
        masks.retain(|mask| mask.area_px >= MIN_PX);
        let (width, height) = loaded.image.dimensions();
        let (regions, masks_of_region) =
            regions::partition(&masks, width, height, width, height, loaded.valid.as_deref());
        self.n_photos += 1;
        self.n_masks += masks.len();
        self.n_photos_without += usize::from(masks.is_empty());
        let pixels = drawing.coverage.iter().zip(&regions.region_of_pixel);
        for (_, region) in pixels.filter(|(share, _)| **share > MIN_COVERAGE) {
            self.n_seen_px += 1;
            self.n_covered_px += u64::from(*region != NO_REGION);
        }
        if let (Some(labels), Some(things)) = (labels, &mut self.things) {
            let ids = true_ids(labels.masks, view, [width, height])?;
            things.add(&regions, &masks_of_region, &ids, &labels.things);
        }
        Ok(())
    }
}

fn true_ids(dir: &Path, view: &View, size_px: [u32; 2]) -> Result<Vec<u16>> {
    let path = slag_encoder::segment::mask_file(dir, view)
        .with_context(|| format!("{}: no mask of {}", dir.display(), view.name))?;
    let ids = image::open(&path).with_context(|| path.display().to_string())?;
    if [ids.width(), ids.height()] != size_px {
        bail!("{}: {}x{} pixels of a photo of {size_px:?}", path.display(), ids.width(), ids.height());
    }
    match ids {
        image::DynamicImage::ImageLuma8(ids) => Ok(ids.as_raw().iter().map(|id| u16::from(*id)).collect()),
        image::DynamicImage::ImageLuma16(ids) => Ok(ids.into_raw()),
        other => bail!("{}: {:?} pixels, expected an id at each", path.display(), other.color()),
    }
}

impl fmt::Display for MasksReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let columns =
            ["scene", "segmenter", "photos (without a mask)", "masks a photo", "covered", "s a photo"];
        let mut table = Table::new(columns);
        for row in &self.rows {
            table.row([
                row.scene.clone(),
                row.segmenter.clone(),
                format!("{} ({})", row.n_photos, row.n_photos_without),
                format!("{:.1}", row.n_masks as f64 / row.n_photos.max(1) as f64),
                percent(row.n_covered_px, row.n_seen_px),
                format!("{:.2}", row.secs),
            ]);
        }
        writeln!(
            f,
            "Masks of at least {MIN_PX} pixels; covered of the pixels with splat behind them.\n\n{table}"
        )?;
        let mut table = Table::new(["scene", "segmenter", "segments", "mean IoU", "found at 0.5"]);
        let labelled: Vec<(&Row, &Ious)> =
            self.rows.iter().filter_map(|row| Some((row, row.things.as_ref()?))).collect();
        for (row, things) in &labelled {
            let found = percent(things.n_above_half as u64, things.n as u64);
            let figures = [things.n.to_string(), figure(things.mean()), found];
            table.row([row.scene.clone(), row.segmenter.clone()].into_iter().chain(figures));
        }
        if labelled.is_empty() {
            return Ok(());
        }
        writeln!(f, "Labelled things: the best IoU of a mask.\n\n{table}")?;
        let all = mean(labelled.iter().map(|(_, things)| things.mean()));
        writeln!(f, "mean IoU over scenes and segmenters: {}", figure(all))
    }
}
