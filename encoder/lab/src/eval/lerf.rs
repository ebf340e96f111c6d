//! LERF-OVS: the open-vocabulary labels that LangSplat (Qin et al. 2024) made for scenes of LERF (Kerr et al. 2023).
//!
//! ```text
//! LABELS/frame_00041.json   labelme-like: info {name, width, height}, objects [{category, bbox, segmentation}]
//! ```
//!
//! `bbox` holds the corners `x1 y1 x2 y2` and `segmentation` a polygon of pixels, as in LangSplat's
//! `eval/evaluate_iou_loc.py`; the frames' poses are those of the scene. Gaussians are selected in 3D and rendered alone, as
//! OpenGaussian (Wu et al. 2024) does: a pixel is selected where their alpha exceeds `MIN_COVERAGE`. A thing is localised if
//! the rendered scores, averaged over a square of `SMOOTHING_PX`, have their maximum inside one of its boxes.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use slag_common::gaussians::SH_C0;
use slag_common::{Gaussians, View};
use slag_models::TextEncoder;

use super::error::{EvalError, check_scene};
use super::metrics::{iou_of_sets, mean};
use super::settings::EvalSettings;
use slag_encoder::query;
use slag_encoder::raster::constants::MAX_IMAGE_PX;
use slag_encoder::raster::{LoadedScene, RasterError, RasterView, Rasterizer};
use slag_encoder::store::StoreReader;

/// Alpha above which a rendered pixel is selected, as in OpenGaussian's `render_lerf_by_text.py`.
const MIN_COVERAGE: f32 = 0.7;
/// Side of the square for averaging scores before the maximum is taken, as in LangSplat.
const SMOOTHING_PX: usize = 30;
/// Largest relative difference between the aspect ratios of a label and its view.
const MAX_ASPECT_ERROR: f64 = 0.01;

/// Error in the labels.
#[derive(Debug, thiserror::Error)]
pub enum LerfError {
    /// A file could not be read.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// A label is malformed.
    #[error("{}: {what}; expected info {{name, width, height}} and objects [{{category, bbox, segmentation}}]", path.display())]
    Label {
        /// The file.
        path: PathBuf,
        /// The problem.
        what: String,
    },
    /// The folder has no labels.
    #[error("{}: no frame_*.json; give the scene's folder under lerf_ovs/label", dir.display())]
    NoLabels {
        /// The folder.
        dir: PathBuf,
    },
    /// No labelled frame has a pose.
    #[error("{}: none of {n} labelled frames has a pose, the first is {first}; give the poses of the same scene", dir.display())]
    NoViews {
        /// The folder.
        dir: PathBuf,
        /// Labelled frames.
        n: usize,
        /// Name of the first.
        first: String,
    },
}

/// A thing on a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledThing {
    /// Its category.
    pub category: String,
    /// Its pixels, row-major.
    pub mask: Vec<bool>,
    /// Boxes of its parts: smallest and largest x and y, pixels.
    pub boxes: Vec<[f64; 4]>,
}

/// A labelled frame.
#[derive(Clone, Debug)]
pub struct LabelledFrame {
    /// Its name.
    pub name: String,
    /// The camera, at the label's size.
    pub view: RasterView,
    /// The things, one per category.
    pub things: Vec<LabelledThing>,
}

/// The labels of a scene.
#[derive(Clone, Debug)]
pub struct LerfLabels {
    /// Frames that have a pose.
    pub frames: Vec<LabelledFrame>,
    /// Names of frames without a pose.
    pub without_view: Vec<String>,
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
    ///
    /// # Errors
    /// [`LerfError`].
    pub fn read(dir: &Path, views: &[View]) -> Result<Self, LerfError> {
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
            let wrong = |what: String| LerfError::Label { path: path.clone(), what };
            let label: Label =
                serde_json::from_slice(&fs_err::read(path)?).map_err(|error| wrong(error.to_string()))?;
            let name = stem(&label.info.name);
            match view_of.get(&name) {
                Some(view) => labels.frames.push(LabelledFrame::new(name, view, label).map_err(wrong)?),
                None => labels.without_view.push(name),
            }
        }
        match (labels.frames.is_empty(), labels.without_view.first()) {
            (true, None) => Err(LerfError::NoLabels { dir: dir.to_owned() }),
            (true, Some(first)) => {
                Err(LerfError::NoViews { dir: dir.to_owned(), n: paths.len(), first: first.clone() })
            }
            _ => Ok(labels),
        }
    }
}

impl LabelledFrame {
    fn new(name: String, view: &View, label: Label) -> Result<Self, String> {
        let Info { width, height, .. } = label.info;
        let n_pixels = u64::from(width) * u64::from(height);
        let camera = view.intrinsics.without_distortion();
        let aspect =
            f64::from(width) * f64::from(camera.height_px) / (f64::from(height) * f64::from(camera.width_px));
        if !(1..=MAX_IMAGE_PX).contains(&n_pixels) || (aspect - 1.0).abs() > MAX_ASPECT_ERROR {
            let of_view = [camera.width_px, camera.height_px];
            return Err(format!("{width} x {height} pixels of a view of {of_view:?}"));
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

/// Sets the pixels in or on a polygon by the even-odd rule; its corners are truncated to whole pixels, as in LangSplat.
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
pub struct ThingReport {
    /// The frame.
    pub frame: String,
    /// The thing.
    pub category: String,
    /// Intersection over union of the rendered selection and its mask.
    pub iou: f64,
    /// Whether the maximum score lies in one of its boxes.
    pub localised: bool,
}

/// Figures of an evaluation.
#[derive(Clone, Debug, Serialize)]
pub struct LerfReport {
    /// The store's encoder.
    pub encoder: String,
    /// Lowest score of a selected Gaussian.
    pub threshold: f32,
    /// Each thing on each frame.
    pub things: Vec<ThingReport>,
    /// Mean intersection over union.
    pub miou: Option<f64>,
    /// Share of the things with an intersection over union above 0.25.
    pub accuracy_at_25: Option<f64>,
    /// Share above 0.5.
    pub accuracy_at_50: Option<f64>,
    /// Share of the things that are localised.
    pub localised: Option<f64>,
    /// Categories that the encoder cannot encode, and why; their things count as not found.
    pub unknown_words: BTreeMap<String, String>,
    /// Labelled frames without a pose; left out of the means.
    pub frames_without_view: Vec<String>,
}

/// Evaluates a store against labels of frames. `scene` is the splat that was encoded.
///
/// # Errors
/// [`EvalError`].
pub fn lerf(
    reader: &StoreReader,
    labels: &LerfLabels,
    scene: &Gaussians,
    encoder: &mut dyn TextEncoder,
    rasterizer: &dyn Rasterizer,
    settings: &EvalSettings,
) -> Result<LerfReport, EvalError> {
    check_scene(reader, scene)?;
    let threshold = settings.threshold.unwrap_or(reader.manifest().encoder.default_threshold);
    let mut words: Vec<&str> =
        labels.frames.iter().flat_map(|f| f.things.iter().map(|t| t.category.as_str())).collect();
    words.sort_unstable();
    words.dedup();
    words.retain(|word| settings.words.is_empty() || settings.words.iter().any(|asked| asked == word));
    let (mut things, mut unknown_words) = (Vec::new(), BTreeMap::new());
    let mut first_error = None;
    for word in words {
        let on_frames =
            labels.frames.iter().filter_map(|f| Some((f, f.things.iter().find(|t| t.category == word)?)));
        let vector = match encoder.encode(word) {
            Ok(vector) => vector,
            Err(error) => {
                things.extend(on_frames.map(|(frame, _)| ThingReport {
                    frame: frame.name.clone(),
                    category: word.to_owned(),
                    iou: 0.0,
                    localised: false,
                }));
                unknown_words.insert(word.to_owned(), error.to_string());
                first_error.get_or_insert((word.to_owned(), error));
                continue;
            }
        };
        let scores = match settings.profile {
            Some(profile) => query::scores_of_shards(reader, &vector, profile)?,
            None => query::scores(reader, &vector)?,
        };
        let (selected, scored) = drawn(scene, &scores.cosines, threshold);
        let (selected, scored) = (rasterizer.load(&selected)?, rasterizer.load(&scored)?);
        for (frame, thing) in on_frames {
            things.push(judge(selected.as_ref(), scored.as_ref(), frame, thing)?);
        }
    }
    if let (true, Some((first, source))) =
        (things.is_empty() || unknown_words.len() == n_words(&things), first_error)
    {
        return Err(EvalError::NoWords { n: unknown_words.len(), first, source: Box::new(source) });
    }
    if things.is_empty() {
        let categories: Vec<&str> =
            labels.frames.iter().flat_map(|f| f.things.iter().map(|t| t.category.as_str())).collect();
        return Err(EvalError::NoCategories { categories: categories.join(", ") });
    }
    let share =
        |test: &dyn Fn(&ThingReport) -> bool| mean(things.iter().map(|t| Some(f64::from(u8::from(test(t))))));
    Ok(LerfReport {
        encoder: reader.manifest().encoder.name.clone(),
        threshold,
        miou: mean(things.iter().map(|thing| Some(thing.iou))),
        accuracy_at_25: share(&|thing| thing.iou > 0.25),
        accuracy_at_50: share(&|thing| thing.iou > 0.5),
        localised: share(&|thing| thing.localised),
        things,
        unknown_words,
        frames_without_view: labels.without_view.clone(),
    })
}

fn n_words(things: &[ThingReport]) -> usize {
    // Things of one word are adjacent.
    things.chunk_by(|a, b| a.category == b.category).count()
}

/// Returns the scene with only the selected Gaussians, and the scene with scores as colours.
fn drawn(scene: &Gaussians, scores: &[f32], threshold: f32) -> (Gaussians, Gaussians) {
    let mut selected = scene.clone();
    selected.sh_degree = 0;
    selected.sh_rest.clear();
    let mut scored = selected.clone();
    // Opacity 0 is never drawn.
    let hide =
        |(opacity, score): (&mut f32, &f32)| *opacity = if *score >= threshold { *opacity } else { 0.0 };
    selected.opacities.iter_mut().zip(scores).for_each(hide);
    // A Gaussian without a score counts as the opposite of the query. Scores become colours of 0 to 1, so none is clamped.
    let colour = |score: f32| (if score.is_nan() { -1.0 } else { score } + 1.0) / 2.0;
    scored.sh_dc.iter_mut().zip(scores).for_each(|(sh, score)| *sh = [(colour(*score) - 0.5) / SH_C0; 3]);
    (selected, scored)
}

fn judge(
    selected: &dyn LoadedScene,
    scored: &dyn LoadedScene,
    frame: &LabelledFrame,
    thing: &LabelledThing,
) -> Result<ThingReport, RasterError> {
    let drawing = selected.draw(&frame.view, [0.0; 3])?;
    let found = drawing.coverage.iter().map(|coverage| *coverage > MIN_COVERAGE);
    let iou = iou_of_sets(found.zip(thing.mask.iter().copied())).unwrap_or(0.0);
    let drawing = scored.draw(&frame.view, [0.0; 3])?;
    let (width, height) = (drawing.width_px as usize, drawing.height_px as usize);
    let values: Vec<f32> = drawing.rgb.chunks_exact(3).map(|rgb| rgb[0]).collect();
    let smooth = box_mean(&values, width, height, SMOOTHING_PX);
    let best = (0..smooth.len()).max_by(|a, b| smooth[*a].total_cmp(&smooth[*b]).then(b.cmp(a)));
    let [x, y] = best.map_or([0.0; 2], |best| [(best % width) as f64, (best / width) as f64]);
    let is_in = |[x1, y1, x2, y2]: &[f64; 4]| (*x1..=*x2).contains(&x) && (*y1..=*y2).contains(&y);
    let localised = thing.boxes.iter().any(is_in);
    Ok(ThingReport { frame: frame.name.clone(), category: thing.category.clone(), iou, localised })
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
        let show = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.3}"));
        writeln!(f, "{:<24} {:<24} {:>6} {:>9}", "frame", "thing", "IoU", "localised")?;
        for t in &self.things {
            let localised = if t.localised { "yes" } else { "no" };
            writeln!(f, "{:<24} {:<24} {:>6.3} {localised:>9}", t.frame, t.category, t.iou)?;
        }
        writeln!(
            f,
            "{} things at threshold {:.3}: mIoU {}, above 0.25: {}, above 0.5: {}, localised {}",
            self.things.len(),
            self.threshold,
            show(self.miou),
            show(self.accuracy_at_25),
            show(self.accuracy_at_50),
            show(self.localised)
        )?;
        for (word, reason) in &self.unknown_words {
            writeln!(f, "unknown to the encoder and counted as not found: {word} ({reason})")?;
        }
        for frame in &self.frames_without_view {
            writeln!(f, "left out without a pose: {frame}")?;
        }
        Ok(())
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
