//! How good answers are, measured against labels.
//!
//! Gaussians are judged in three dimensions as the ScanNet protocol of the field does (argmax over the
//! categories' words: mIoU and mAcc; OpenGaussian, Wu et al. 2024), per word as retrieval (IoU at the
//! threshold, average precision, area under the ROC curve), and on views kept for tests as LERF does (Kerr et
//! al. 2023): the scores are rendered, the best pixel must lie on the thing (localisation), and the pixels
//! above the threshold are compared with its mask.

pub mod encoder;
mod filter;
mod instances;
pub mod lerf;
pub mod mask_noise;
pub mod metrics;
pub mod noise;
#[cfg(test)]
mod public_tests;
pub mod scannet;
mod truth;

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;
use slag_common::Gaussians;
use slag_common::gaussians::SH_C0;
use slag_models::{EncodeError, TextEncoder};

pub use filter::Filter;
pub use instances::{InstanceReport, Recall};
use metrics::{Confusion, area_under_roc, average_precision, iou_of_sets, mean};
use slag_common::manifest::Calibration;
use slag_common::shard::Profile;
use slag_encoder::lift::superpoint::{SuperpointSettings, Superpoints};
use slag_encoder::query::{self, ByLevel, PublishedObjects, QueryError};
use slag_encoder::raster::{RasterError, RasterView, Rasterizer};
use slag_encoder::store::StoreReader;
pub use truth::{LabelledView, Thing, Truth, TruthError};

/// Fewer matching Gaussians are no answer.
const MIN_ANSWER: usize = 10;
/// A thing with fewer pixels on a view is not looked for there.
const MIN_PIXELS: usize = 100;
/// Sizes of the class lists that are reported, as in the ScanNet protocol, largest categories first.
const SUBSETS: [usize; 3] = [19, 15, 10];
/// Asked for although they are nowhere, where the scene has none of them.
const ABSENT: [&str; 24] = [
    "elephant",
    "airplane",
    "boat",
    "piano",
    "guitar",
    "horse",
    "cat",
    "bird",
    "fish",
    "snake",
    "banana",
    "pizza",
    "train",
    "helicopter",
    "bathtub",
    "toilet",
    "shower",
    "umbrella",
    "bicycle",
    "motorcycle",
    "tent",
    "ladder",
    "tractor",
    "traffic light",
];

/// Said beside figures of public data sets.
const NO_PAPER_ROWS: &str = "published rows: this project's files have none to quote";

/// Why an evaluation ended without figures.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// The labels cannot be used.
    #[error(transparent)]
    Truth(#[from] TruthError),
    /// The splat is another one than was encoded.
    #[error("the store has {n_store} Gaussians, the splat {n_scene}; give the splat that was encoded")]
    Scene {
        /// Gaussians of the store.
        n_store: usize,
        /// Gaussians of the splat.
        n_scene: usize,
    },
    /// The scan cannot be used.
    #[error(transparent)]
    Scan(#[from] scannet::ScanError),
    /// The store cannot be scored.
    #[error(transparent)]
    Query(#[from] QueryError),
    /// A view cannot be drawn.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// None of the words can be asked.
    #[error("the encoder knows none of {n} words ({first}: {source}); give others with --words")]
    NoWords {
        /// How many were tried.
        n: usize,
        /// The first.
        first: String,
        /// Why not.
        source: Box<EncodeError>,
    },
    /// The scene has no thing of these words.
    #[error("no word is a category of the labels; there are: {there}")]
    NoCategories {
        /// The categories.
        there: String,
    },
}

/// Figures of a word.
#[derive(Clone, Debug, Serialize)]
pub struct WordReport {
    /// The category.
    pub word: String,
    /// Gaussians that are labelled so.
    pub n_gaussians: usize,
    /// Intersection over union of the argmax over all words.
    pub iou: Option<f64>,
    /// Part of its Gaussians that the argmax gives it.
    pub accuracy: Option<f64>,
    /// Intersection over union of the Gaussians above the threshold, among all things.
    pub iou_at_threshold: Option<f64>,
    /// Average precision among all things.
    pub average_precision: Option<f64>,
    /// Area under the ROC curve among all things.
    pub area_under_roc: Option<f64>,
    /// On test views: the best pixel lies on the thing, of the views that show it.
    pub localised: Option<f64>,
    /// On test views: intersection over union of the pixels above the threshold.
    pub iou_on_views: Option<f64>,
    /// Test views that show it.
    pub n_views: usize,
}

/// Means over a list of classes.
#[derive(Clone, Debug, Serialize)]
pub struct Subset {
    /// Classes.
    pub n_classes: usize,
    /// Mean intersection over union.
    pub miou: Option<f64>,
    /// Mean accuracy.
    pub macc: Option<f64>,
}

/// What an evaluation found.
#[derive(Clone, Debug, Serialize)]
pub struct EvalReport {
    /// The store's encoder.
    pub encoder: String,
    /// Scores of this profile's shards; the full field if absent.
    pub profile: Option<Profile>,
    /// How superpoints answered together; absent where each Gaussian answered for itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub filter: Option<Filter>,
    /// What was scored.
    pub level: EvalLevel,
    /// Whether levels of masks were scored apart.
    pub by_mask_level: bool,
    /// How many of the things objects find; only where objects were scored.
    pub instances: Option<InstanceReport>,
    /// Score from which something counts as found.
    pub threshold: f32,
    /// Each word.
    pub words: Vec<WordReport>,
    /// All classes, and the largest ones.
    pub multi_class: Vec<Subset>,
    /// Mean over words.
    pub mean_iou_at_threshold: Option<f64>,
    /// Mean over words.
    pub mean_average_precision: Option<f64>,
    /// Mean over words.
    pub mean_area_under_roc: Option<f64>,
    /// Mean over words that test views show.
    pub mean_localised: Option<f64>,
    /// Mean over words that test views show.
    pub mean_iou_on_views: Option<f64>,
    /// Words that are nowhere in the scene: how many found nothing.
    pub abstained: [usize; 2],
    /// Words that the encoder cannot encode, and why: not in any mean.
    pub unknown_words: BTreeMap<String, String>,
    /// Gaussians of the words' things without any embedding: counted as wrong.
    pub n_without_evidence: usize,
    /// Gaussians that belong to no thing: not counted.
    pub n_unlabelled: usize,
}

/// What is scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum EvalLevel {
    /// Each Gaussian by itself.
    Gaussians,
    /// Objects, and the Gaussians within them ([`PublishedObjects::overlay`]); those without by themselves.
    Objects,
}

/// What to evaluate.
#[derive(Clone, Debug, Default)]
pub struct EvalSettings {
    /// Words to ask; the labels' categories if empty.
    pub words: Vec<String>,
    /// Scores of this profile's shards instead of the full field.
    pub profile: Option<Profile>,
    /// Score from which something counts as found; the store's own if absent.
    pub threshold: Option<f32>,
    /// Lets superpoints of colour and shape answer together.
    pub filter: Option<Filter>,
    /// What is scored; objects if the scene has them, if absent.
    pub level: Option<EvalLevel>,
    /// Scores levels of masks apart and takes the best ([`ByLevel`]); of the full field only.
    pub by_mask_level: bool,
}

/// A word's scores: of Gaussians, and of objects where those are scored.
type WordScores = (Vec<f32>, Vec<f32>);

/// Evaluates a store against labels. `scene`: the splat that was encoded, for the test views.
///
/// # Errors
/// [`EvalError`].
pub fn labelled(
    reader: &StoreReader,
    truth: &Truth,
    scene: &Gaussians,
    encoder: &mut dyn TextEncoder,
    rasterizer: &dyn Rasterizer,
    settings: &EvalSettings,
) -> Result<EvalReport, EvalError> {
    check_scene(reader, scene)?;
    let all = truth.categories();
    let mut unknown_words = BTreeMap::new();
    let mut first_error = None;
    let mut classes: Vec<(String, Vec<u16>)> = Vec::new();
    let mut scores: Vec<Vec<f32>> = Vec::new();
    let objects = match settings.level {
        Some(EvalLevel::Gaussians) => None,
        Some(EvalLevel::Objects) => Some(PublishedObjects::read(reader)?),
        None => PublishedObjects::find(reader)?,
    };
    let by_level = settings.by_mask_level.then(|| ByLevel::read(reader)).transpose()?;
    let mut of_objects: Vec<Vec<f32>> = Vec::new();
    let mut score = |text: &str| -> Result<Option<WordScores>, EvalError> {
        let vector = match encoder.encode(text) {
            Ok(vector) => vector,
            Err(error) => {
                unknown_words.insert(text.to_owned(), error.to_string());
                first_error.get_or_insert((text.to_owned(), error));
                return Ok(None);
            }
        };
        let mut scores = match (settings.profile, &by_level) {
            (Some(profile), _) => query::scores_of_shards(reader, &vector, profile)?,
            (None, Some(by_level)) => by_level.scores(&vector)?,
            (None, None) => query::scores(reader, &vector)?,
        };
        let of_objects = objects.as_ref().map(|objects| objects.scores(&vector)).unwrap_or_default();
        objects.iter().for_each(|objects| objects.overlay(&of_objects, &mut scores.cosines));
        Ok(Some((scores.cosines, of_objects)))
    };
    let there = || all.iter().map(|(word, _)| word.as_str()).collect::<Vec<_>>().join(", ");
    for (word, ids) in &all {
        if !settings.words.is_empty() && !settings.words.contains(word) {
            continue;
        }
        if let Some((cosines, of_word)) = score(word)? {
            classes.push((word.clone(), ids.clone()));
            scores.push(cosines);
            of_objects.push(of_word);
        }
    }
    let encoder_record = &reader.manifest().encoder;
    let of_scene = encoder_record.default_threshold;
    let of_object = |objects: &PublishedObjects| match encoder_record.calibration {
        // A scene's own threshold is three spreads above the mean: of what is scored.
        Some(_) => {
            let Calibration { score_mean, score_spread } = objects.calibration;
            (score_mean + 3.0 * score_spread).clamp(-1.0, 1.0)
        }
        None => of_scene,
    };
    let threshold = settings
        .threshold
        .unwrap_or_else(|| objects.as_ref().map_or(of_scene, |o| query::mixed(of_scene, of_object(o))));
    let is_there = |word: &str| {
        let things = truth.things.iter().chain(&truth.background);
        things.into_iter().any(|t| t.category.contains(word) || t.words.iter().any(|w| w.contains(word)))
    };
    let mut abstained = [0, 0];
    for word in ABSENT.into_iter().filter(|word| !is_there(word)) {
        if let Some((cosines, _)) = score(word)? {
            let n = cosines.iter().filter(|c| **c >= threshold).count();
            abstained[0] += usize::from(n < MIN_ANSWER);
            abstained[1] += 1;
        }
    }
    if classes.is_empty() {
        return Err(match first_error {
            Some((first, source)) => {
                EvalError::NoWords { n: unknown_words.len(), first, source: Box::new(source) }
            }
            None => EvalError::NoCategories { there: there() },
        });
    }

    let superpoints = settings.filter.map(|_| Superpoints::new(scene, None, &SuperpointSettings::of_looks()));
    if let (Some(Filter::Mean), Some(superpoints)) = (settings.filter, &superpoints) {
        scores.iter_mut().for_each(|scores| filter::average(scores, superpoints));
    }

    // Gaussians of things: what retrieval is judged on. Those of the words' classes: what argmax is judged on.
    let class_of_id: BTreeMap<u16, usize> =
        classes.iter().enumerate().flat_map(|(c, (_, ids))| ids.iter().map(move |id| (*id, c))).collect();
    let thing_ids: Vec<u16> = truth.things.iter().map(|thing| thing.id).collect();
    let of_things: Vec<usize> =
        (0..truth.id_of_gaussian.len()).filter(|i| thing_ids.contains(&truth.id_of_gaussian[*i])).collect();
    let n_unlabelled = truth
        .id_of_gaussian
        .iter()
        .filter(|id| !thing_ids.contains(id) && !truth.background.iter().any(|thing| thing.id == **id))
        .count();
    let class_of = |gaussian: usize| class_of_id.get(&truth.id_of_gaussian[gaussian]).copied();
    let confusion = |n_classes: usize| {
        let mut confusion = Confusion::new(n_classes);
        let best = |gaussian: usize| {
            (0..n_classes)
                .filter(|c| !scores[*c][gaussian].is_nan())
                .max_by(|a, b| scores[*a][gaussian].total_cmp(&scores[*b][gaussian]).then(b.cmp(a)))
        };
        let mut answers: Vec<Option<usize>> = (0..truth.id_of_gaussian.len()).map(best).collect();
        if let (Some(Filter::Majority), Some(superpoints)) = (settings.filter, &superpoints) {
            filter::vote(&mut answers, superpoints);
        }
        for (gaussian, class) in of_things.iter().filter_map(|i| Some((*i, class_of(*i)?))) {
            if class < n_classes {
                confusion.count(class, answers[gaussian]);
            }
        }
        confusion
    };
    let n_classes = classes.len();
    let whole = confusion(n_classes);
    let multi_class = std::iter::once(n_classes)
        .chain(SUBSETS.into_iter().filter(|n| *n < n_classes))
        .map(|n| {
            let confusion = if n == n_classes { whole.clone() } else { confusion(n) };
            Subset {
                n_classes: n,
                miou: mean((0..n).map(|c| confusion.iou(c))),
                macc: mean((0..n).map(|c| confusion.accuracy(c))),
            }
        })
        .collect();
    let n_without_evidence =
        of_things.iter().filter(|i| class_of(**i).is_some() && scores[0][**i].is_nan()).count();

    let instances = objects.as_ref().map(|objects| {
        let threshold = settings.threshold.unwrap_or_else(|| of_object(objects));
        instances::report(truth, &objects.object_of, objects.ids.len(), &classes, &of_objects, threshold)
    });
    let mut words = Vec::new();
    for (c, (word, ids)) in classes.iter().enumerate() {
        let positive: Vec<bool> = of_things.iter().map(|i| class_of(*i) == Some(c)).collect();
        // No evidence is the worst of all scores.
        let of_word: Vec<f32> =
            of_things.iter().map(|i| Some(scores[c][*i]).filter(|s| !s.is_nan()).unwrap_or(-2.0)).collect();
        let found = of_word.iter().map(|score| *score >= threshold);
        let on_views = on_views(scene, &scores[c], ids, &truth.views, threshold, rasterizer)?;
        words.push(WordReport {
            word: word.clone(),
            n_gaussians: positive.iter().filter(|p| **p).count(),
            iou: whole.iou(c),
            accuracy: whole.accuracy(c),
            iou_at_threshold: iou_of_sets(found.zip(positive.iter().copied())),
            average_precision: average_precision(&of_word, &positive),
            area_under_roc: area_under_roc(&of_word, &positive),
            localised: mean(on_views.iter().map(|(hit, _)| Some(f64::from(*hit)))),
            iou_on_views: mean(on_views.iter().map(|(_, iou)| Some(*iou))),
            n_views: on_views.len(),
        });
    }
    Ok(EvalReport {
        encoder: reader.manifest().encoder.name.clone(),
        profile: settings.profile,
        filter: settings.filter,
        by_mask_level: settings.by_mask_level,
        level: if objects.is_some() { EvalLevel::Objects } else { EvalLevel::Gaussians },
        instances,
        threshold,
        multi_class,
        mean_iou_at_threshold: mean(words.iter().map(|w| w.iou_at_threshold)),
        mean_average_precision: mean(words.iter().map(|w| w.average_precision)),
        mean_area_under_roc: mean(words.iter().map(|w| w.area_under_roc)),
        mean_localised: mean(words.iter().map(|w| w.localised)),
        mean_iou_on_views: mean(words.iter().map(|w| w.iou_on_views)),
        words,
        abstained,
        unknown_words,
        n_without_evidence,
        n_unlabelled,
    })
}

/// Refuses a splat that is not the one that was encoded.
fn check_scene(reader: &StoreReader, scene: &Gaussians) -> Result<(), EvalError> {
    let manifest = reader.manifest();
    let n_store = (manifest.n_gaussians + manifest.n_rejected) as usize;
    if n_store != scene.len() { Err(EvalError::Scene { n_store, n_scene: scene.len() }) } else { Ok(()) }
}

/// Renders a word's scores on the views that show its things; whether the best pixel lies on one (1 or 0), and
/// the intersection over union of the pixels above the threshold.
fn on_views(
    scene: &Gaussians,
    scores: &[f32],
    ids: &[u16],
    views: &[LabelledView],
    threshold: f32,
    rasterizer: &dyn Rasterizer,
) -> Result<Vec<(f32, f64)>, RasterError> {
    let mut found = Vec::new();
    if views.is_empty() {
        return Ok(found);
    }
    let mut scored = scene.clone();
    // What has no score counts as the opposite of the query; as a colour it must not be clamped at 0.
    let lift = |score: f32| (if score.is_nan() { -1.0 } else { score } + 1.0) / 2.0;
    scored.sh_degree = 0;
    scored.sh_rest.clear();
    scored.sh_dc.iter_mut().zip(scores).for_each(|(sh, score)| *sh = [(lift(*score) - 0.5) / SH_C0; 3]);
    for labelled in views {
        let on_thing: Vec<bool> = labelled.ids.iter().map(|id| ids.contains(id)).collect();
        if on_thing.iter().filter(|on| **on).count() < MIN_PIXELS {
            continue;
        }
        let view = RasterView {
            camera_from_world: labelled.view.camera_from_world,
            intrinsics: labelled.view.intrinsics,
        };
        let drawing = rasterizer.draw(&scored, &view, [0.0; 3])?;
        let rendered: Vec<f32> = drawing.rgb.chunks_exact(3).map(|rgb| rgb[0]).collect();
        let best = (0..rendered.len()).max_by(|a, b| rendered[*a].total_cmp(&rendered[*b]).then(b.cmp(a)));
        let hit = best.is_some_and(|best| on_thing[best]);
        let above = rendered.iter().map(|value| *value >= lift(threshold));
        let iou = iou_of_sets(above.zip(on_thing.iter().copied())).unwrap_or(0.0);
        found.push((f32::from(u8::from(hit)), iou));
    }
    Ok(found)
}

impl fmt::Display for EvalReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let show = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.3}"));
        let head = ["IoU", "acc", "IoU@thr", "AP", "AUC", "loc 2D", "IoU 2D", "views"];
        writeln!(f, "{:<20} {:>9} {}", "word", "Gaussians", head.map(|h| format!("{h:>8}")).join(" "))?;
        for w in &self.words {
            let figures = [
                w.iou,
                w.accuracy,
                w.iou_at_threshold,
                w.average_precision,
                w.area_under_roc,
                w.localised,
                w.iou_on_views,
            ];
            let figures = figures.map(|v| format!("{:>8}", show(v))).join(" ");
            writeln!(f, "{:<20} {:>9} {figures} {:>8}", w.word, w.n_gaussians, w.n_views)?;
        }
        for s in &self.multi_class {
            writeln!(f, "{} classes: mIoU {}, mAcc {}", s.n_classes, show(s.miou), show(s.macc))?;
        }
        writeln!(
            f,
            "means: IoU at threshold {:.3} {}, AP {}, AUC {}; on test views: localised {}, IoU {}",
            self.threshold,
            show(self.mean_iou_at_threshold),
            show(self.mean_average_precision),
            show(self.mean_area_under_roc),
            show(self.mean_localised),
            show(self.mean_iou_on_views)
        )?;
        writeln!(f, "words that are nowhere: {} of {} found nothing", self.abstained[0], self.abstained[1])?;
        if let Some(found) = &self.instances {
            let InstanceReport { n_objects, any, of_words, best_of_words } = found;
            writeln!(f, "{n_objects} objects; things found at IoU 0.25 and 0.5, by any object: {any}")?;
            writeln!(
                f,
                "  by one of its word's above the threshold: {of_words}; by its word's best: {best_of_words}"
            )?;
        }
        if !self.unknown_words.is_empty() {
            let words: Vec<&str> = self.unknown_words.keys().map(String::as_str).collect();
            writeln!(f, "unknown to the encoder, in no mean: {}", words.join(", "))?;
        }
        writeln!(
            f,
            "{} Gaussians without evidence count as wrong, {} without label are left out",
            self.n_without_evidence, self.n_unlabelled
        )
    }
}
