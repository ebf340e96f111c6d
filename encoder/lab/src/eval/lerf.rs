//! LERF-OVS: the open-vocabulary labels that LangSplat (Qin et al. 2024) made for scenes of LERF (Kerr et al.
//! 2023).
//!
//! ```text
//! LABELS/frame_00041.json   labelme-like: info {name, width, height}, objects [{category, bbox, segmentation}]
//! ```
//!
//! `bbox` holds the corners `x1 y1 x2 y2` and `segmentation` a polygon of pixels, as in LangSplat's
//! `eval/evaluate_iou_loc.py`; the frames' poses are those of the scene. Gaussians are selected in 3D and rendered
//! alone, as OpenGaussian (Wu et al. 2024) does: a pixel is selected where their alpha exceeds `MIN_COVERAGE`. A
//! thing is localised if the rendered scores, averaged over a square of `SMOOTHING_PX`, have their maximum inside
//! one of its boxes.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use serde::{Deserialize, Serialize};
use slag_common::gaussians::SH_C0;
use slag_common::shard::Profile;
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
/// Side of the square for averaging scores before the maximum is taken, as in LangSplat.
const SMOOTHING_PX: usize = 30;
/// Largest relative difference between the aspect ratios of a label and its view.
const MAX_ASPECT_ERROR: f64 = 0.01;

/// The threshold of the paper's figures.
const PAPERS_THRESHOLD: f32 = 0.28;

/// `eval lerf`.
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
    /// Scores this profile's shards, as a robot does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    profile: Option<Profile>,
}

pub(crate) fn run(args: &LerfArgs) -> Result<LerfReport> {
    let reader = StoreReader::open(&args.store)?;
    let mut encoder = text_encoder_of(&reader, &args.models)?;
    let views = poses::read(&args.views, None)?;
    let frame = ingest::find_frame(&args.scene, &args.splat_frame, views.source, views.applied)?;
    let mut scene = splat::read(&args.scene, &splat::ReadOptions { with_sh_rest: false })?;
    if let Some(frame) = frame {
        tracing::info!("{frame}; the splat is brought into the world of the poses");
        frame.to_poses(&mut scene);
    }
    let labels = LerfLabels::read(&args.labels, &views.views)?;
    judge(&reader, &labels, &scene, &mut *encoder, &args.threshold, args.profile)
}

/// A thing on a frame.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct LabelledThing {
    pub(super) category: String,
    /// Its pixels, row-major.
    pub(super) mask: Vec<bool>,
    /// Boxes of its parts: smallest and largest x and y, pixels.
    pub(super) boxes: Vec<[f64; 4]>,
}

#[derive(Clone, Debug)]
pub(super) struct LabelledFrame {
    pub(super) name: String,
    /// The camera, at the label's size.
    pub(super) view: RasterView,
    /// The things, one per category.
    pub(super) things: Vec<LabelledThing>,
}

#[derive(Clone, Debug)]
pub(super) struct LerfLabels {
    /// Frames that have a pose.
    pub(super) frames: Vec<LabelledFrame>,
    /// Names of frames without a pose.
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
    bbox: Corners,
    segmentation: Polygons,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Corners {
    Flat([f64; 4]),
    Pairs([[f64; 2]; 2]),
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Polygons {
    One(Vec<[f64; 2]>),
    Many(Vec<Vec<[f64; 2]>>),
}

impl LerfLabels {
    /// Reads the labels of a scene with these views.
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
                    "{}: expected info {{name, width, height}} and objects [{{category, bbox, segmentation}}]",
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
            let [x1, y1, x2, y2] = match object.bbox {
                Corners::Flat(corners) => corners,
                Corners::Pairs([[x1, y1], [x2, y2]]) => [x1, y1, x2, y2],
            };
            let polygons = match object.segmentation {
                Polygons::One(polygon) => vec![polygon],
                Polygons::Many(polygons) => polygons,
            };
            let thing = things.entry(object.category.clone()).or_insert_with(|| LabelledThing {
                category: object.category,
                mask: vec![false; size[0] * size[1]],
                boxes: Vec::new(),
            });
            thing.boxes.push([x1.min(x2), y1.min(y2), x1.max(x2), y1.max(y2)]);
            polygons.iter().for_each(|polygon| fill(polygon, size, &mut thing.mask));
        }
        let camera_from_world = view.camera_from_world;
        let view = RasterView { camera_from_world, intrinsics: camera.scaled_to(width, height) };
        Ok(Self { name, view, things: things.into_values().collect() })
    }
}

/// Sets the pixels in or on a polygon by the even-odd rule; its corners are truncated to whole pixels, as in
/// LangSplat.
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

/// Figures of a thing on a frame.
#[derive(Clone, Debug, Serialize)]
pub(super) struct ThingReport {
    pub(super) frame: String,
    pub(super) category: String,
    /// Intersection over union of the rendered selection and its mask, for each threshold.
    pub(super) ious: Vec<f64>,
    /// Whether the maximum score lies in one of its boxes.
    pub(super) localised: bool,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct LerfReport {
    encoder: String,
    thresholds: Vec<f32>,
    pub(super) things: Vec<ThingReport>,
    /// Categories that the encoder cannot encode, and why; their things count as not found.
    pub(super) unknown_words: BTreeMap<String, String>,
    /// Labelled frames without a pose; left out of the means.
    pub(super) frames_without_view: Vec<String>,
}

/// Evaluates a store against labels of frames. `scene` is the splat that was encoded.
pub(super) fn judge(
    reader: &StoreReader,
    labels: &LerfLabels,
    scene: &Gaussians,
    encoder: &mut dyn TextEncoder,
    thresholds: &[f32],
    profile: Option<Profile>,
) -> Result<LerfReport> {
    check_scene(reader, scene.len())?;
    let mut on_frames: BTreeMap<&str, Vec<(&LabelledFrame, &LabelledThing)>> = BTreeMap::new();
    for (frame, thing) in labels.frames.iter().flat_map(|f| f.things.iter().map(move |t| (f, t))) {
        on_frames.entry(&thing.category).or_default().push((frame, thing));
    }
    let (mut things, mut unknown_words) = (Vec::new(), BTreeMap::new());
    for (word, on_frames) in &on_frames {
        let cosines = match (encoder.encode(word), profile) {
            (Ok(vector), Some(profile)) => query::scores_of_shards(reader, &vector, profile)?.cosines,
            (Ok(vector), None) => query::scores(reader, &vector)?.cosines,
            (Err(error), _) => {
                unknown_words.insert((*word).to_owned(), error.to_string());
                things.extend(on_frames.iter().map(|(frame, _)| ThingReport {
                    frame: frame.name.clone(),
                    category: (*word).to_owned(),
                    ious: vec![0.0; thresholds.len()],
                    localised: false,
                }));
                continue;
            }
        };
        let scored = scored(scene, &cosines);
        let scored = CpuRasterizer.load(&scored)?;
        let selected: Vec<Gaussians> = thresholds.iter().map(|t| selected(scene, &cosines, *t)).collect();
        let selected =
            selected.iter().map(|scene| CpuRasterizer.load(scene)).collect::<Result<Vec<_>, _>>()?;
        for (frame, thing) in on_frames {
            let ious =
                selected.iter().map(|s| selection_iou(s.as_ref(), frame, thing)).collect::<Result<_>>()?;
            let localised = is_localised(scored.as_ref(), frame, thing)?;
            let (frame, category) = (frame.name.clone(), thing.category.clone());
            things.push(ThingReport { frame, category, ious, localised });
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
    /// Returns for a threshold the mean IoU, and the shares of things with one above 0.25 and 0.5.
    pub(super) fn means(&self, at: usize) -> [Option<f64>; 3] {
        let above =
            |least: f64| mean(self.things.iter().map(|t| Some(f64::from(u8::from(t.ious[at] > least)))));
        [mean(self.things.iter().map(|t| Some(t.ious[at]))), above(0.25), above(0.5)]
    }

    /// Returns whether every word is known, and every frame has a pose.
    pub(crate) fn is_complete(&self) -> bool {
        self.unknown_words.is_empty() && self.frames_without_view.is_empty()
    }
}

/// Returns the scene with only the Gaussians that reach the threshold.
fn selected(scene: &Gaussians, scores: &[f32], threshold: f32) -> Gaussians {
    let mut selected = scene.clone();
    (selected.sh_degree, selected.sh_rest) = (0, Vec::new());
    // Opacity 0 is never drawn.
    let hide =
        |(opacity, score): (&mut f32, &f32)| *opacity = if *score >= threshold { *opacity } else { 0.0 };
    selected.opacities.iter_mut().zip(scores).for_each(hide);
    selected
}

/// Returns the scene with scores as colours.
fn scored(scene: &Gaussians, scores: &[f32]) -> Gaussians {
    let mut scored = scene.clone();
    (scored.sh_degree, scored.sh_rest) = (0, Vec::new());
    // A Gaussian without a score counts as the opposite of the query. Scores become colours of 0 to 1, so none is
    // clamped.
    let colour = |score: f32| (if score.is_nan() { -1.0 } else { score } + 1.0) / 2.0;
    scored.sh_dc.iter_mut().zip(scores).for_each(|(sh, score)| *sh = [(colour(*score) - 0.5) / SH_C0; 3]);
    scored
}

fn selection_iou(selected: &dyn LoadedScene, frame: &LabelledFrame, thing: &LabelledThing) -> Result<f64> {
    let drawing = selected.draw(&frame.view, [0.0; 3])?;
    let found = drawing.coverage.iter().map(|coverage| *coverage > MIN_COVERAGE);
    Ok(iou_of_sets(found.zip(thing.mask.iter().copied())).unwrap_or(0.0))
}

/// Returns whether the best score, smoothed, lies in one of the thing's boxes.
fn is_localised(scored: &dyn LoadedScene, frame: &LabelledFrame, thing: &LabelledThing) -> Result<bool> {
    let drawing = scored.draw(&frame.view, [0.0; 3])?;
    let (width, height) = (drawing.width_px as usize, drawing.height_px as usize);
    let values: Vec<f32> = drawing.rgb.chunks_exact(3).map(|rgb| rgb[0]).collect();
    let smooth = box_mean(&values, width, height, SMOOTHING_PX);
    let best = (0..smooth.len()).max_by(|a, b| smooth[*a].total_cmp(&smooth[*b]).then(b.cmp(a)));
    let [x, y] = best.map_or([0.0; 2], |best| [(best % width) as f64, (best / width) as f64]);
    let is_in = |[x1, y1, x2, y2]: &[f64; 4]| (*x1..=*x2).contains(&x) && (*y1..=*y2).contains(&y);
    Ok(thing.boxes.iter().any(is_in))
}

/// Returns the mean over a square around each pixel, clipped to the image, by a summed-area table (Crow 1984).
fn box_mean(values: &[f32], width: usize, height: usize, side: usize) -> Vec<f64> {
    let mut sums = vec![0.0f64; (width + 1) * (height + 1)];
    for y in 0..height {
        let mut row = 0.0;
        for x in 0..width {
            row += f64::from(values[y * width + x]);
            sums[(y + 1) * (width + 1) + x + 1] = sums[y * (width + 1) + x + 1] + row;
        }
    }
    let range = |at: usize, size: usize| (at.saturating_sub(side / 2), (at + side.div_ceil(2)).min(size));
    let mean = |x: usize, y: usize| {
        let ((x1, x2), (y1, y2)) = (range(x, width), range(y, height));
        let at = |x: usize, y: usize| sums[y * (width + 1) + x];
        (at(x2, y2) - at(x1, y2) - at(x2, y1) + at(x1, y1)) / ((x2 - x1) * (y2 - y1)) as f64
    };
    (0..width * height).map(|pixel| mean(pixel % width, pixel / width)).collect()
}

impl fmt::Display for LerfReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = ["frame", "thing", "localised"].map(str::to_owned);
        let thresholds = self.thresholds.iter().map(|threshold| format!("IoU at {threshold}"));
        let mut table = Table::new(names.into_iter().chain(thresholds));
        for t in &self.things {
            let localised = if t.localised { "yes" } else { "no" }.to_owned();
            let ious = t.ious.iter().map(|iou| figure(Some(*iou)));
            table.row([t.frame.clone(), t.category.clone(), localised].into_iter().chain(ious));
        }
        writeln!(f, "{table}")?;
        let mut table = Table::new(["threshold", "things", "mIoU", "above 0.25", "above 0.5", "localised"]);
        let localised = mean(self.things.iter().map(|t| Some(f64::from(u8::from(t.localised)))));
        for (at, threshold) in self.thresholds.iter().enumerate() {
            let means = self.means(at).into_iter().chain([localised]).map(figure);
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

    #[test]
    fn means_are_those_of_the_square() {
        let (width, height) = (7, 5);
        let values: Vec<f32> = (0..35).map(|i| (i * i % 11) as f32).collect();
        let found = box_mean(&values, width, height, 3);
        for (pixel, found) in found.iter().enumerate() {
            let (x, y) = ((pixel % width) as i64, (pixel / width) as i64);
            let near = (0..35i64).filter(|p| (p % 7 - x).abs() <= 1 && (p / 7 - y).abs() <= 1);
            let near: Vec<f64> = near.map(|p| f64::from(values[p as usize])).collect();
            assert!((found - near.iter().sum::<f64>() / near.len() as f64).abs() < 1e-9);
        }
    }
}
