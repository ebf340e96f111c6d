//! `eval masks`: judges segmenters without words. On labelled photos by the best mask of each labelled segment; on
//! all photos by the share of the scene that masks cover, and by agreement between views.

mod agreement;
mod segments;

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
use slag_encoder::progress::{Progress, Silent};
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
use crate::generate::Scene;
use crate::generate::grammar::SceneKind;
use crate::scenes::SceneFiles;
use crate::table::{Table, figure, percent};
use agreement::{Agreement, Seen};
use segments::{Ious, MIN_PX, Segments};

/// Opacity from which a pixel has splat behind it.
const MIN_COVERAGE: f32 = 0.5;
const N_GENERATED_VIEWS: u32 = 24;

/// `eval masks`.
#[derive(Debug, Args)]
pub(crate) struct MasksArgs {
    /// Scenes: a splat, poses and photos; gt/masks and gt/instances.json where there are labels.
    #[arg(long, value_name = "DIR", num_args = 1..)]
    scene: Vec<PathBuf>,
    /// Kinds of scenes to generate and judge as well.
    #[arg(long, value_enum, value_delimiter = ',')]
    kind: Vec<SceneKind>,
    /// Seeds of each kind.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [31, 32])]
    seeds: Vec<u64>,
    /// Folder for generated scenes; what an earlier run left there is used.
    #[arg(long, value_name = "DIR", default_value = "target/masks")]
    out: PathBuf,
    /// Segmenters: auto (the built-in one), graph (it without its model), or the folder of a Segment Anything
    /// model.
    #[arg(long, value_name = "auto|graph|DIR,...", value_delimiter = ',', default_value = "auto")]
    segmenter: Vec<PathBuf>,
    /// Most photos of a scene: pairs of neighbours, evenly spread [default: all].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..))]
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
    agreement: Agreement,
    /// Absent without labels.
    segments: Option<Segments>,
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
    let mut dirs = args.scene.clone();
    for (kind, seed) in args.kind.iter().flat_map(|kind| args.seeds.iter().map(move |seed| (kind, *seed))) {
        dirs.push(generated(*kind, seed, &args.out)?);
    }
    if dirs.is_empty() {
        bail!("nothing to judge; give --scene or --kind");
    }
    let mut rows = Vec::new();
    for files in SceneFiles::find_all(&dirs)? {
        let gaussians = splat::read(&files.splat, &ReadOptions { with_sh_rest: false })?;
        let scene = devices.load(&gaussians)?;
        let all = poses::read(&files.poses, files.images.as_deref())?.views;
        let views = pairs(&all, args.views_limit);
        for name in &args.segmenter {
            let segmenter = open(name, &session)?;
            progress.begin(&format!("{} {}", files.name, name.display()), "photo", views.len() as u64 * 2, 0);
            let judge =
                Judge { files: &files, scene: scene.as_ref(), segmenter: segmenter.as_ref(), progress };
            let row = judge.row(&views, name).with_context(|| files.dir.display().to_string())?;
            rows.push(row);
            progress.end();
        }
    }
    Ok(MasksReport { rows })
}

fn generated(kind: SceneKind, seed: u64, out: &Path) -> Result<PathBuf> {
    let dir = out.join(format!("{kind:?}-{seed}").to_lowercase());
    if !dir.join("transforms.json").is_file() {
        Scene::new(&[kind], seed, N_GENERATED_VIEWS).write(&dir, &Silent)?;
    }
    Ok(dir)
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

/// Returns pairs of neighbouring views, evenly spread where `limit` photos are fewer than all.
fn pairs(views: &[View], limit: Option<u32>) -> Vec<[&View; 2]> {
    let all: Vec<[&View; 2]> = views.chunks_exact(2).map(|pair| [&pair[0], &pair[1]]).collect();
    let n = limit.map_or(all.len(), |limit| (limit as usize / 2).clamp(1, all.len().max(1)));
    (0..n.min(all.len())).map(|i| all[i * all.len() / n]).collect()
}

struct Judge<'a> {
    files: &'a SceneFiles,
    scene: &'a dyn LoadedScene,
    segmenter: &'a dyn Segmenter,
    progress: &'a dyn Progress,
}

impl Judge<'_> {
    fn row(&self, pairs: &[[&View; 2]], name: &Path) -> Result<Row> {
        let mut row = Row { scene: self.files.name.clone(), ..Row::default() };
        row.segmenter = name.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let labels = match &self.files.true_masks {
            Some(dir) => Some((dir, read_things(&self.files.dir)?)),
            None => None,
        };
        row.segments = labels.is_some().then(Segments::default);
        for pair in pairs {
            let mut seen = Vec::new();
            for view in pair {
                let of_view = || view.name.clone();
                let photo = self.photo(view, &mut row).with_context(of_view)?;
                if let (Some((dir, (things, background))), Some(segments)) = (&labels, &mut row.segments) {
                    let known = things.iter().chain(background).map(|thing| thing.id);
                    let ids = true_ids(dir, view, [photo.regions.width_px, photo.regions.height_px])?;
                    let things = things.iter().map(|thing| thing.id).collect();
                    segments.add(&photo.regions, &photo.masks_of_region, &ids, &known.collect(), &things);
                }
                seen.push(photo);
                self.progress.advance(1);
            }
            row.agreement.add(&seen[0], &seen[1]);
        }
        row.secs /= row.n_photos.max(1) as f64;
        Ok(row)
    }

    fn photo(&self, view: &View, row: &mut Row) -> Result<Seen> {
        let loaded = ingest::load_image(view)?;
        let view = RasterView::of(&loaded.view);
        let drawing = self.scene.draw(&view, [0.0; 3])?;
        let is_seen: Vec<bool> = drawing.coverage.iter().map(|share| *share > MIN_COVERAGE).collect();
        let depth: Vec<f32> = drawing
            .depth
            .iter()
            .zip(&is_seen)
            .map(|(depth, is_seen)| if *is_seen { *depth } else { 0.0 })
            .collect();
        let start = Instant::now();
        let mut masks: Vec<Mask> = self.segmenter.segment(&SegmentInput::new(&loaded, Some(&depth[..])))?;
        row.secs += start.elapsed().as_secs_f64();
        masks.retain(|mask| mask.area_px >= MIN_PX);
        let (width_px, height_px) = loaded.image.dimensions();
        let valid = loaded.valid.as_deref();
        let (regions, masks_of_region) =
            regions::partition(&masks, width_px, height_px, width_px, height_px, valid);
        row.n_photos += 1;
        row.n_masks += masks.len();
        row.n_photos_without += usize::from(masks.is_empty());
        let pixels = is_seen.iter().zip(&regions.region_of_pixel).filter(|(is_seen, _)| **is_seen);
        for (_, region) in pixels {
            row.n_seen_px += 1;
            row.n_covered_px += u64::from(*region != NO_REGION);
        }
        Ok(Seen { view, depth, regions, masks_of_region })
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
        let columns = ["scene", "segmenter", "photos (without a mask)", "masks a photo", "covered"];
        let mut table = Table::new(columns.into_iter().chain(["agreement", "agree at 0.5", "s a photo"]));
        for row in &self.rows {
            table.row([
                row.scene.clone(),
                row.segmenter.clone(),
                format!("{} ({})", row.n_photos, row.n_photos_without),
                format!("{:.1}", row.n_masks as f64 / row.n_photos.max(1) as f64),
                percent(row.n_covered_px, row.n_seen_px),
                figure(row.agreement.ious.mean()),
                format!("{} of {}", row.agreement.ious.found(), row.agreement.ious.n),
                format!("{:.2}", row.secs),
            ]);
        }
        writeln!(
            f,
            "Masks of at least {MIN_PX} pixels. Covered: of the pixels with splat behind them. Agreement: best IoU of"
        )?;
        writeln!(f, "a mask drawn into the next photo with a mask there.\n\n{table}")?;
        let columns =
            ["scene", "segmenter", "segments", "mean IoU", "found at 0.5", "small / medium / large"];
        let mut table = Table::new(columns.into_iter().chain(["split / merged / lost", "background found"]));
        let mut n_things = 0;
        for (row, segments) in self.rows.iter().filter_map(|row| Some((row, row.segments.as_ref()?))) {
            let all = segments.things();
            n_things += all.n;
            let share = |n: usize| percent(n as u64, all.n as u64);
            table.row([
                row.scene.clone(),
                row.segmenter.clone(),
                all.n.to_string(),
                figure(all.mean()),
                all.found(),
                segments.by_size.each_ref().map(Ious::found).join(" / "),
                [segments.n_split, segments.n_merged, segments.n_lost].map(share).join(" / "),
                segments.background.found(),
            ]);
        }
        if n_things > 0 {
            let all =
                mean(self.rows.iter().filter_map(|row| row.segments.as_ref()).map(|s| s.things().mean()));
            writeln!(
                f,
                "Labelled things on photos: the best IoU of a mask; small below 32x32 pixels, large from 96x96 on."
            )?;
            writeln!(
                f,
                "Of those not found: split has masks inside, merged a mask around it, lost neither.\n\n{table}"
            )?;
            writeln!(f, "mean IoU over scenes and segmenters: {}", figure(all))?;
        }
        Ok(())
    }
}
