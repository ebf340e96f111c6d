//! LERF-OVS: the open-vocabulary labels that LangSplat (Qin et al. 2024) made for scenes of LERF (Kerr et al.
//! 2023).
//!
//! ```text
//! LABELS/frame_00041.json   labelme-like: info {name, width, height}, objects [{category, segmentation}]
//! ```
//!
//! `segmentation` is a polygon of pixels, as in LangSplat's `eval/evaluate_iou_loc.py`; the frames' poses are those
//! of the scene. Gaussians are selected in 3D and rendered alone, as OpenGaussian (Wu et al. 2024) does: a pixel is
//! selected where their alpha exceeds `MIN_COVERAGE`.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use serde::{Deserialize, Serialize};
use slag_common::{Gaussians, View, poses, splat};
use slag_encoder::cli::common::{ModelArgs, parse_frame, text_encoder_of};
use slag_encoder::ingest::{self, FrameChoice};
use slag_encoder::query;
use slag_encoder::raster::constants::MAX_IMAGE_PX;
use slag_encoder::raster::{CpuRasterizer, LoadedScene, RasterView, Rasterizer};
use slag_encoder::store::StoreReader;
use slag_models::TextEncoder;

use super::metrics::{iou_of_sets, mean};
use super::truth::check_scene;
use crate::table::{Table, figure};

/// Alpha above which a rendered pixel is selected, as in OpenGaussian's `render_lerf_by_text.py`.
const MIN_COVERAGE: f32 = 0.7;
/// Largest relative difference between the aspect ratios of a label and its view.
const MAX_ASPECT_ERROR: f64 = 0.01;

const PAPERS_THRESHOLD: f32 = 0.28;

#[derive(Debug, Args)]
pub(crate) struct LerfArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    store: PathBuf,
    /// The splat that was encoded.
    #[arg(long, value_name = "FILE")]
    scene: PathBuf,
    /// The poses that it was encoded with.
    #[arg(long, value_name = "PATH")]
    views: PathBuf,
    /// Labels of the scene: lerf_ovs/label/SCENE.
    #[arg(long, value_name = "DIR")]
    labels: PathBuf,
    /// Says how the splat's frame follows from that of the poses, see `slag-encoder encode --help`: auto, none or
    /// a file.
    #[arg(long, value_name = "auto|none|FILE", default_value = "auto", value_parser = parse_frame)]
    splat_frame: FrameChoice,
    /// The models that the store was encoded with.
    #[command(flatten)]
    models: ModelArgs,
    /// Lowest scores of a selected Gaussian; a row of the table each. One that the scene's own labels chose is no
    /// comparison.
    #[arg(long, value_name = "COSINE,...", value_delimiter = ',', default_values_t = [PAPERS_THRESHOLD])]
    threshold: Vec<f32>,
}

pub(crate) fn run(args: &LerfArgs) -> Result<LerfReport> {
    let reader = StoreReader::open(&args.store)?;
    let mut encoder = text_encoder_of(&reader, &args.models)?;
    let views = poses::read(&args.views, None)?;
    let mut scene = splat::read(&args.scene, &splat::ReadOptions { with_sh_rest: false })?;
    ingest::to_poses(&mut scene, &args.scene, &args.splat_frame, views.source, views.applied)?;
    let labels = LerfLabels::read(&args.labels, &views.views)?;
    judge(&reader, &labels, &scene, &mut *encoder, &args.threshold)
}

#[derive(Clone, Debug, PartialEq)]
pub(super) struct LabelledThing {
    pub(super) category: String,
    /// Row-major.
    pub(super) mask: Vec<bool>,
}

#[derive(Clone, Debug)]
pub(super) struct LabelledFrame {
    pub(super) name: String,
    /// At the label's size.
    pub(super) view: RasterView,
    pub(super) things: Vec<LabelledThing>,
}

#[derive(Clone, Debug)]
pub(super) struct LerfLabels {
    pub(super) frames: Vec<LabelledFrame>,
    pub(super) without_view: Vec<String>,
}

#[derive(Deserialize)]
struct Label {
    info: Info,
    objects: Vec<Object>,
}

#[derive(Deserialize)]
struct Info {
    name: String,
    width: u32,
    height: u32,
}

#[derive(Deserialize)]
struct Object {
    category: String,
    segmentation: Polygons,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Polygons {
    One(Vec<[f64; 2]>),
    Many(Vec<Vec<[f64; 2]>>),
}

impl LerfLabels {
    pub(super) fn read(dir: &Path, views: &[View]) -> Result<Self> {
        let mut paths = Vec::new();
        for entry in fs_err::read_dir(dir)? {
            let path = entry?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if name.starts_with("frame_") && name.ends_with(".json") {
                paths.push(path);
            }
        }
        paths.sort();
        let stem =
            |name: &str| Path::new(name).file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let view_of: BTreeMap<String, &View> = views.iter().map(|view| (stem(&view.name), view)).collect();
        let mut labels = Self { frames: Vec::new(), without_view: Vec::new() };
        for path in &paths {
            let expected = || {
                format!(
                    "{}: expected info {{name, width, height}} and objects [{{category, segmentation}}]",
                    path.display()
                )
            };
            let label: Label = serde_json::from_slice(&fs_err::read(path)?).with_context(expected)?;
            let name = stem(&label.info.name);
            match view_of.get(&name) {
                Some(view) => {
                    labels.frames.push(LabelledFrame::new(name, view, label).with_context(expected)?);
                }
                None => labels.without_view.push(name),
            }
        }
        let (dir, n) = (dir.display(), paths.len());
        match (labels.frames.is_empty(), labels.without_view.first()) {
            (true, None) => {
                Err(anyhow!("{dir}: no frame_*.json; give the scene's folder under lerf_ovs/label"))
            }
            (true, Some(first)) => Err(anyhow!(
                "{dir}: none of {n} labelled frames has a pose, the first is {first}; give the poses of the same scene"
            )),
            _ => Ok(labels),
        }
    }
}

impl LabelledFrame {
    fn new(name: String, view: &View, label: Label) -> Result<Self> {
        let Info { width, height, .. } = label.info;
        let n_pixels = u64::from(width) * u64::from(height);
        let camera = view.intrinsics.without_distortion();
        let aspect =
            f64::from(width) * f64::from(camera.height_px) / (f64::from(height) * f64::from(camera.width_px));
        if !(1..=MAX_IMAGE_PX).contains(&n_pixels) || (aspect - 1.0).abs() > MAX_ASPECT_ERROR {
            let of_view = [camera.width_px, camera.height_px];
            bail!("{width} x {height} pixels of a view of {of_view:?}");
        }
        let size = [width as usize, height as usize];
        let mut things: BTreeMap<String, LabelledThing> = BTreeMap::new();
        for object in label.objects {
            let polygons = match object.segmentation {
                Polygons::One(polygon) => vec![polygon],
                Polygons::Many(polygons) => polygons,
            };
            let thing = things.entry(object.category.clone()).or_insert_with(|| LabelledThing {
                category: object.category,
                mask: vec![false; size[0] * size[1]],
            });
            polygons.iter().for_each(|polygon| fill(polygon, size, &mut thing.mask));
        }
        let camera_from_world = view.camera_from_world;
        let view = RasterView { camera_from_world, intrinsics: camera.scaled_to(width, height) };
        Ok(Self { name, view, things: things.into_values().collect() })
    }
}

/// Sets the pixels in or on a polygon (even-odd rule); corners are truncated to whole pixels, as in LangSplat.
fn fill(polygon: &[[f64; 2]], [width, height]: [usize; 2], mask: &mut [bool]) {
    let corners: Vec<[i64; 2]> = polygon.iter().map(|corner| corner.map(|v| v as i32 as i64)).collect();
    let edges: Vec<_> = corners.iter().zip(corners.iter().cycle().skip(1)).collect();
    let (low, high) = (corners.iter().map(|c| c[1]).min(), corners.iter().map(|c| c[1]).max());
    let (Some(low), Some(high)) = (low, high) else { return };
    let mut set = |y: i64, from: f64, to: f64| {
        let first = from.ceil().max(0.0) as usize;
        let end = (to.floor() + 1.0).clamp(0.0, width as f64) as usize;
        if first < end {
            mask[y as usize * width + first..y as usize * width + end].fill(true);
        }
    };
    for y in low.max(0)..=high.min(height as i64 - 1) {
        let mut crossings = Vec::new();
        for ([x1, y1], [x2, y2]) in edges.iter().copied() {
            let at = |y: i64| *x1 as f64 + (x2 - x1) as f64 * (y - y1) as f64 / (y2 - y1) as f64;
            // Half-open, so that a corner counts once; pixels on the border are set separately.
            if (*y1 <= y) != (*y2 <= y) {
                crossings.push(at(y));
            }
            if y1 == y2 && *y1 == y {
                set(y, (*x1).min(*x2) as f64, (*x1).max(*x2) as f64);
            } else if y1 != y2 && (*y1.min(y2)..=*y1.max(y2)).contains(&y) {
                set(y, at(y), at(y));
            }
        }
        crossings.sort_unstable_by(f64::total_cmp);
        crossings.chunks_exact(2).for_each(|pair| set(y, pair[0], pair[1]));
    }
}

#[derive(Clone, Debug, Serialize)]
pub(super) struct ThingReport {
    pub(super) frame: String,
    pub(super) category: String,
    /// Intersection over union of the rendered selection and its mask, for each threshold.
    pub(super) ious: Vec<f64>,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct LerfReport {
    encoder: String,
    thresholds: Vec<f32>,
    pub(super) things: Vec<ThingReport>,
    /// Categories that the encoder cannot encode, and why; their things count as not found.
    pub(super) unknown_words: BTreeMap<String, String>,
    pub(super) frames_without_view: Vec<String>,
}

/// Evaluates a store against labels of frames. `scene` is the splat that was encoded.
pub(super) fn judge(
    reader: &StoreReader,
    labels: &LerfLabels,
    scene: &Gaussians,
    encoder: &mut dyn TextEncoder,
    thresholds: &[f32],
) -> Result<LerfReport> {
    check_scene(reader, scene.len())?;
    let mut on_frames: BTreeMap<&str, Vec<(&LabelledFrame, &LabelledThing)>> = BTreeMap::new();
    for (frame, thing) in labels.frames.iter().flat_map(|f| f.things.iter().map(move |t| (f, t))) {
        on_frames.entry(&thing.category).or_default().push((frame, thing));
    }
    let (mut things, mut unknown_words) = (Vec::new(), BTreeMap::new());
    for (word, on_frames) in &on_frames {
        let cosines = match encoder.encode(word) {
            Ok(vector) => query::scores(reader, &vector)?.cosines,
            Err(error) => {
                unknown_words.insert((*word).to_owned(), error.to_string());
                things.extend(on_frames.iter().map(|(frame, _)| ThingReport {
                    frame: frame.name.clone(),
                    category: (*word).to_owned(),
                    ious: vec![0.0; thresholds.len()],
                }));
                continue;
            }
        };
        let selected: Vec<Gaussians> = thresholds.iter().map(|t| selected(scene, &cosines, *t)).collect();
        let selected =
            selected.iter().map(|scene| CpuRasterizer.load(scene)).collect::<Result<Vec<_>, _>>()?;
        for (frame, thing) in on_frames {
            let ious =
                selected.iter().map(|s| selection_iou(s.as_ref(), frame, thing)).collect::<Result<_>>()?;
            things.push(ThingReport { frame: frame.name.clone(), category: thing.category.clone(), ious });
        }
    }
    if unknown_words.len() == on_frames.len() {
        bail!("the encoder knows none of {} words: {unknown_words:?}", on_frames.len());
    }
    Ok(LerfReport {
        encoder: reader.manifest().encoder.name.clone(),
        thresholds: thresholds.to_vec(),
        things,
        unknown_words,
        frames_without_view: labels.without_view.clone(),
    })
}

impl LerfReport {
    /// Mean IoU at a threshold, and the shares of things with an IoU above 0.25 and above 0.5.
    pub(super) fn means(&self, at: usize) -> [Option<f64>; 3] {
        let above =
            |least: f64| mean(self.things.iter().map(|t| Some(f64::from(u8::from(t.ious[at] > least)))));
        [mean(self.things.iter().map(|t| Some(t.ious[at]))), above(0.25), above(0.5)]
    }

    pub(crate) fn is_complete(&self) -> bool {
        self.unknown_words.is_empty() && self.frames_without_view.is_empty()
    }
}

fn selected(scene: &Gaussians, scores: &[f32], threshold: f32) -> Gaussians {
    let mut selected = scene.clone();
    (selected.sh_degree, selected.sh_rest) = (0, Vec::new());
    // Opacity 0 is never drawn.
    let hide =
        |(opacity, score): (&mut f32, &f32)| *opacity = if *score >= threshold { *opacity } else { 0.0 };
    selected.opacities.iter_mut().zip(scores).for_each(hide);
    selected
}

fn selection_iou(selected: &dyn LoadedScene, frame: &LabelledFrame, thing: &LabelledThing) -> Result<f64> {
    let drawing = selected.draw(&frame.view, [0.0; 3])?;
    let found = drawing.coverage.iter().map(|coverage| *coverage > MIN_COVERAGE);
    Ok(iou_of_sets(found.zip(thing.mask.iter().copied())).unwrap_or(0.0))
}

impl fmt::Display for LerfReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = ["frame", "thing"].map(str::to_owned);
        let thresholds = self.thresholds.iter().map(|threshold| format!("IoU at {threshold}"));
        let mut table = Table::new(names.into_iter().chain(thresholds));
        for t in &self.things {
            let ious = t.ious.iter().map(|iou| figure(Some(*iou)));
            table.row([t.frame.clone(), t.category.clone()].into_iter().chain(ious));
        }
        writeln!(f, "{table}")?;
        let mut table = Table::new(["threshold", "things", "mIoU", "above 0.25", "above 0.5"]);
        for (at, threshold) in self.thresholds.iter().enumerate() {
            let means = self.means(at).map(figure);
            table.row([threshold.to_string(), self.things.len().to_string()].into_iter().chain(means));
        }
        write!(f, "{table}")?;
        for (word, reason) in &self.unknown_words {
            writeln!(f, "unknown to the encoder and counted as not found: {word} ({reason})")?;
        }
        self.frames_without_view.iter().try_for_each(|frame| writeln!(f, "left out without a pose: {frame}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: each pixel's distance to every edge, and the even-odd rule along a ray in another direction.
    #[test]
    fn polygons_are_filled_with_their_border() {
        let size = [24, 18];
        let polygons: [&[[f64; 2]]; 5] = [
            &[[2.0, 2.0], [12.9, 2.0], [12.0, 9.0], [2.0, 9.0]],
            &[[4.0, 1.0], [20.0, 8.0], [9.0, 16.0]],
            // A star that crosses itself.
            &[[12.0, 1.0], [17.0, 16.0], [3.0, 6.0], [21.0, 6.0], [7.0, 16.0]],
            // Partly outside.
            &[[-6.0, -3.0], [30.0, 5.0], [10.0, 40.0]],
            &[[5.0, 5.0]],
        ];
        for polygon in polygons {
            let mut mask = vec![false; size[0] * size[1]];
            fill(polygon, size, &mut mask);
            for (pixel, found) in mask.iter().enumerate() {
                let (x, y) = ((pixel % size[0]) as f64, (pixel / size[0]) as f64);
                let corners: Vec<[f64; 2]> = polygon.iter().map(|c| c.map(f64::trunc)).collect();
                let (mut on_border, mut inside) = (false, false);
                for (a, b) in corners.iter().zip(corners.iter().cycle().skip(1)) {
                    let cross = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]);
                    let within = |i: usize, v: f64| (a[i].min(b[i])..=a[i].max(b[i])).contains(&v);
                    on_border |= cross == 0.0 && within(0, x) && within(1, y);
                    // Upwards.
                    if (a[0] > x) != (b[0] > x) {
                        inside ^= a[1] + (b[1] - a[1]) * (x - a[0]) / (b[0] - a[0]) < y;
                    }
                }
                assert_eq!(*found, on_border || inside, "{polygon:?} at {x} {y}");
            }
        }
        fill(&[], size, &mut [false; 24 * 18]);
    }
}
