//! Judges a store by labels of every Gaussian.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use serde::Serialize;
use slag_common::manifest::Calibration;
use slag_common::shard::Profile;
use slag_encoder::query::{self, PublishedObjects};
use slag_encoder::store::StoreReader;
use slag_models::TextEncoder;

use super::instances::{self, InstanceReport};
use super::metrics::{Confusion, area_under_roc, average_precision, iou_of_sets, mean};
use super::truth::Truth;
use crate::table::{Table, figure};

/// A query with fewer matching Gaussians counts as unanswered.
const MIN_ANSWER: usize = 10;
/// Sizes of the reported class lists, as in the ScanNet protocol; the largest categories come first.
const SUBSETS: [usize; 3] = [19, 15, 10];

/// Negative queries: categories absent from most scenes. Those that a scene does have are left out.
pub(super) const ABSENT: &str = "elephant,airplane,boat,piano,guitar,horse,cat,bird,fish,snake,banana,pizza,train,helicopter,\
                                 bathtub,toilet,shower,umbrella,bicycle,motorcycle,tent,ladder,tractor,traffic light";

/// What is scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub(crate) enum EvalKind {
    /// Each Gaussian by itself.
    Gaussians,
    /// Objects and the Gaussians within them; Gaussians without an object by themselves.
    Objects,
}

impl fmt::Display for EvalKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if *self == Self::Gaussians { "Gaussian" } else { "object" })
    }
}

/// How a store is judged.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct JudgeSettings {
    /// Scores this profile's shards, as a robot does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    pub(crate) profile: Option<Profile>,
    /// Lowest score of a match [default: the store's].
    #[arg(long, value_name = "COSINE")]
    pub(crate) threshold: Option<f32>,
    /// What is scored [default: objects, where the scene has them].
    #[arg(long, value_enum)]
    pub(crate) kind: Option<EvalKind>,
}

/// `eval labelled`.
#[derive(Debug, Args)]
pub(crate) struct LabelledArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub(crate) store: PathBuf,
    /// Folder of the labels: gt/instances.json, gt/gaussian_instance.npy.
    #[arg(long, value_name = "DIR")]
    pub(crate) truth: PathBuf,
    #[command(flatten)]
    pub(crate) judge: JudgeSettings,
    /// The models that the store was encoded with.
    #[command(flatten)]
    pub(crate) models: slag_encoder::cli::common::ModelArgs,
}

/// Figures of a word, among the Gaussians of all things.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct WordReport {
    word: String,
    n_gaussians: usize,
    /// Intersection over union of the argmax over all words.
    iou: Option<f64>,
    /// Share of its Gaussians that the argmax assigns to it.
    accuracy: Option<f64>,
    iou_at_threshold: Option<f64>,
    average_precision: Option<f64>,
    area_under_roc: Option<f64>,
}

/// Means over a list of classes.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Subset {
    pub(crate) n_classes: usize,
    pub(crate) miou: Option<f64>,
    pub(crate) macc: Option<f64>,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct EvalReport {
    pub(crate) encoder: String,
    /// Profile of the scored shards; absent for the full field.
    profile: Option<Profile>,
    pub(crate) kind: EvalKind,
    /// Only where objects were scored.
    pub(crate) instances: Option<InstanceReport>,
    threshold: f32,
    words: Vec<WordReport>,
    /// All classes, and the largest ones.
    pub(crate) multi_class: Vec<Subset>,
    mean_iou_at_threshold: Option<f64>,
    pub(crate) mean_average_precision: Option<f64>,
    pub(crate) mean_area_under_roc: Option<f64>,
    /// Negative queries: how many found nothing, and how many there were.
    pub(crate) abstained: [usize; 2],
    /// Words that the encoder cannot encode, and why; no mean counts them.
    unknown_words: BTreeMap<String, String>,
    /// Gaussians of the words' things without an embedding; they count as wrong.
    n_without_evidence: usize,
    /// Gaussians that belong to no thing; they are not counted.
    n_unlabelled: usize,
}

pub(crate) fn judge(
    reader: &StoreReader,
    truth: &Truth,
    encoder: &mut dyn TextEncoder,
    settings: &JudgeSettings,
) -> Result<EvalReport> {
    let objects = match settings.kind {
        Some(EvalKind::Gaussians) => None,
        Some(EvalKind::Objects) => Some(PublishedObjects::read(reader)?),
        None => PublishedObjects::find(reader)?,
    };
    let mut asker = Asker { reader, objects: objects.as_ref(), encoder, settings, unknown: BTreeMap::new() };
    let classes = asker.classes(truth)?;
    let (threshold, of_objects) = thresholds(reader, objects.as_ref(), settings);
    let abstained = asker.abstained(truth, threshold)?;
    let things = Things::of(truth, &classes);
    let whole = things.confusion(&classes, classes.len());
    let subset = |n: usize| {
        let confusion = things.confusion(&classes, n);
        let (iou, accuracy) = (|c| confusion.iou(c), |c| confusion.accuracy(c));
        Subset { n_classes: n, miou: mean((0..n).map(iou)), macc: mean((0..n).map(accuracy)) }
    };
    let sizes = std::iter::once(classes.len()).chain(SUBSETS.into_iter().filter(|n| *n < classes.len()));
    let of_class = |(c, class): (usize, &Class)| things.retrieval(c, class, &whole, threshold);
    let words: Vec<WordReport> = classes.iter().enumerate().map(of_class).collect();
    let is_unanswered = |(i, c): &&(usize, Option<usize>)| c.is_some() && classes[0].cosines[*i].is_nan();
    Ok(EvalReport {
        encoder: reader.manifest().encoder.name.clone(),
        profile: settings.profile,
        kind: if objects.is_some() { EvalKind::Objects } else { EvalKind::Gaussians },
        instances: objects.as_ref().map(|objects| {
            let classes = classes.iter().map(|class| (&class.ids[..], &class.of_objects[..]));
            instances::report(truth, &objects.object_of, objects.ids.len(), classes, of_objects)
        }),
        threshold,
        multi_class: sizes.map(subset).collect(),
        mean_iou_at_threshold: mean(words.iter().map(|w| w.iou_at_threshold)),
        mean_average_precision: mean(words.iter().map(|w| w.average_precision)),
        mean_area_under_roc: mean(words.iter().map(|w| w.area_under_roc)),
        words,
        abstained,
        unknown_words: asker.unknown,
        n_without_evidence: things.gaussians.iter().filter(is_unanswered).count(),
        n_unlabelled: things.n_unlabelled,
    })
}

struct Class {
    word: String,
    ids: Vec<u16>,
    /// `[N]`; NaN without evidence.
    cosines: Vec<f32>,
    /// By object; empty where objects are not scored.
    of_objects: Vec<f32>,
}

struct Asker<'a> {
    reader: &'a StoreReader,
    objects: Option<&'a PublishedObjects>,
    encoder: &'a mut dyn TextEncoder,
    settings: &'a JudgeSettings,
    unknown: BTreeMap<String, String>,
}

impl Asker<'_> {
    /// Scores of Gaussians and of objects; `None` for a word unknown to the encoder.
    fn score(&mut self, word: &str) -> Result<Option<(Vec<f32>, Vec<f32>)>> {
        // A synonym's results say nothing about the word itself.
        let asked_as = self.encoder.known_phrases().and_then(|known| known.asked_as(word));
        let encoded = match asked_as {
            Some(other) => Err(format!("asked as {other}")),
            None => self.encoder.encode(word).map_err(|error| error.to_string()),
        };
        let vector = match encoded {
            Ok(vector) => vector,
            Err(reason) => {
                self.unknown.insert(word.to_owned(), reason);
                return Ok(None);
            }
        };
        let mut scores = match self.settings.profile {
            Some(profile) => query::scores_of_shards(self.reader, &vector, profile)?,
            None => query::scores(self.reader, &vector)?,
        };
        let of_objects = self.objects.map(|objects| objects.scores(&vector)).unwrap_or_default();
        if let Some(objects) = self.objects {
            objects.overlay(&of_objects, &mut scores.cosines);
        }
        Ok(Some((scores.cosines, of_objects)))
    }

    fn classes(&mut self, truth: &Truth) -> Result<Vec<Class>> {
        let mut classes = Vec::new();
        for (word, ids) in truth.categories() {
            if let Some((cosines, of_objects)) = self.score(&word)? {
                classes.push(Class { word, ids, cosines, of_objects });
            }
        }
        match self.unknown.first_key_value() {
            _ if !classes.is_empty() => Ok(classes),
            Some((word, error)) => {
                bail!("the encoder knows none of {} words ({word}: {error})", self.unknown.len())
            }
            None => bail!("the labels name no things"),
        }
    }

    /// Returns the numbers of absent categories that find nothing and that were asked.
    fn abstained(&mut self, truth: &Truth, threshold: f32) -> Result<[usize; 2]> {
        let is_present = |word: &str| {
            let mut things = truth.things.iter().chain(&truth.background);
            things.any(|t| t.category.contains(word) || t.words.iter().any(|w| w.contains(word)))
        };
        let mut abstained = [0, 0];
        for word in ABSENT.split(',').filter(|word| !is_present(word)) {
            if let Some((cosines, _)) = self.score(word)? {
                let n = cosines.iter().filter(|c| **c >= threshold).count();
                abstained[0] += usize::from(n < MIN_ANSWER);
                abstained[1] += 1;
            }
        }
        Ok(abstained)
    }
}

/// Least scores of Gaussians and of objects that match.
fn thresholds(
    reader: &StoreReader,
    objects: Option<&PublishedObjects>,
    settings: &JudgeSettings,
) -> (f32, f32) {
    let record = &reader.manifest().encoder;
    let of_scene = record.default_threshold;
    let of_objects = match (objects, record.calibration) {
        // A scene's own threshold lies three spreads above the mean of the scores, here those of objects.
        (Some(objects), Some(_)) => {
            let Calibration { score_mean, score_spread } = objects.calibration;
            (score_mean + 3.0 * score_spread).clamp(-1.0, 1.0)
        }
        _ => of_scene,
    };
    let of_gaussians = if objects.is_some() { query::mixed(of_scene, of_objects) } else { of_scene };
    (settings.threshold.unwrap_or(of_gaussians), settings.threshold.unwrap_or(of_objects))
}

/// The judged Gaussians: those of all things for retrieval, those of the queried categories for argmax.
struct Things {
    /// The Gaussians of all things, with their class where it was asked for.
    gaussians: Vec<(usize, Option<usize>)>,
    n_unlabelled: usize,
}

impl Things {
    fn of(truth: &Truth, classes: &[Class]) -> Self {
        let of_class =
            |(c, class): (usize, &Class)| class.ids.iter().map(move |id| (*id, c)).collect::<Vec<_>>();
        let class_of_id: BTreeMap<u16, usize> = classes.iter().enumerate().flat_map(of_class).collect();
        let is_in = |things: &[super::truth::Thing], id: u16| things.iter().any(|thing| thing.id == id);
        let (mut gaussians, mut n_unlabelled) = (Vec::new(), 0);
        for (gaussian, id) in truth.id_of_gaussian.iter().enumerate() {
            if is_in(&truth.things, *id) {
                gaussians.push((gaussian, class_of_id.get(id).copied()));
            } else {
                n_unlabelled += usize::from(!is_in(&truth.background, *id));
            }
        }
        Self { gaussians, n_unlabelled }
    }

    /// Counts the best of the first `n_classes` classes at each Gaussian; ties go to the first.
    fn confusion(&self, classes: &[Class], n_classes: usize) -> Confusion {
        let mut confusion = Confusion::new(n_classes);
        for (gaussian, class) in &self.gaussians {
            let Some(class) = class.filter(|class| *class < n_classes) else { continue };
            let score = |c: &usize| classes[*c].cosines[*gaussian];
            let known = (0..n_classes).filter(|c| !score(c).is_nan());
            confusion.count(class, known.max_by(|a, b| score(a).total_cmp(&score(b)).then(b.cmp(a))));
        }
        confusion
    }

    fn retrieval(&self, c: usize, class: &Class, whole: &Confusion, threshold: f32) -> WordReport {
        let positive: Vec<bool> = self.gaussians.iter().map(|(_, of)| *of == Some(c)).collect();
        // Gaussians without evidence rank below all others.
        let score = |(i, _): &(usize, _)| Some(class.cosines[*i]).filter(|s| !s.is_nan()).unwrap_or(-2.0);
        let scores: Vec<f32> = self.gaussians.iter().map(score).collect();
        let found = scores.iter().map(|score| *score >= threshold);
        WordReport {
            word: class.word.clone(),
            n_gaussians: positive.iter().filter(|p| **p).count(),
            iou: whole.iou(c),
            accuracy: whole.accuracy(c),
            iou_at_threshold: iou_of_sets(found.zip(positive.iter().copied())),
            average_precision: average_precision(&scores, &positive),
            area_under_roc: area_under_roc(&scores, &positive),
        }
    }
}

impl fmt::Display for EvalReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut table = Table::new(["word", "Gaussians", "IoU", "acc", "IoU@thr", "AP", "AUC"]);
        for w in &self.words {
            let figures = [w.iou, w.accuracy, w.iou_at_threshold, w.average_precision, w.area_under_roc];
            table.row([w.word.clone(), w.n_gaussians.to_string()].into_iter().chain(figures.map(figure)));
        }
        writeln!(f, "{table}")?;
        for s in &self.multi_class {
            writeln!(f, "{} classes: mIoU {}, mAcc {}", s.n_classes, figure(s.miou), figure(s.macc))?;
        }
        let [at_threshold, ap, auc] =
            [self.mean_iou_at_threshold, self.mean_average_precision, self.mean_area_under_roc].map(figure);
        writeln!(f, "means: IoU at threshold {:.3} {at_threshold}, AP {ap}, AUC {auc}", self.threshold)?;
        writeln!(f, "negative queries: {} of {} found nothing", self.abstained[0], self.abstained[1])?;
        if let Some(found) = &self.instances {
            write!(f, "{found}")?;
        }
        if !self.unknown_words.is_empty() {
            let words: Vec<&str> = self.unknown_words.keys().map(String::as_str).collect();
            writeln!(f, "unknown to the encoder and left out of the means: {}", words.join(", "))?;
        }
        let (n, of) = (self.n_without_evidence, self.n_unlabelled);
        writeln!(f, "{n} Gaussians without evidence count as wrong, {of} without a label are left out")
    }
}
