//! Evaluates a store against a scene with a label for every Gaussian.

use std::collections::BTreeMap;

use slag_common::Gaussians;
use slag_common::manifest::Calibration;
use slag_encoder::lift::superpoint::{SuperpointSettings, Superpoints};
use slag_encoder::query::{self, ByLevel, PublishedObjects};
use slag_encoder::raster::Rasterizer;
use slag_encoder::store::StoreReader;
use slag_models::TextEncoder;

use super::error::{EvalError, check_scene};
use super::filter::{self, Filter};
use super::instances;
use super::metrics::{Confusion, area_under_roc, average_precision, iou_of_sets, mean};
use super::on_views::on_views;
use super::own_best;
use super::report::{EvalReport, Subset, WordReport};
use super::settings::{ABSENT, EvalKind, EvalSettings};
use super::truth::Truth;

/// A query with fewer matching Gaussians counts as unanswered.
const MIN_ANSWER: usize = 10;
/// Sizes of the reported class lists, as in the ScanNet protocol; the largest categories come first.
const SUBSETS: [usize; 3] = [19, 15, 10];

/// A word's scores of Gaussians, and of objects where those are scored.
type WordScores = (Vec<f32>, Vec<f32>);

/// Evaluates a store against labels.
///
/// `scene` is the splat that was encoded; it is drawn on the test views.
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
    let objects = match settings.kind {
        Some(EvalKind::Gaussians) => None,
        Some(EvalKind::Objects) => Some(PublishedObjects::read(reader)?),
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
    let categories = || all.iter().map(|(word, _)| word.as_str()).collect::<Vec<_>>().join(", ");
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
        // A scene's own threshold lies three spreads above the mean of the scores, here those of objects.
        Some(_) => {
            let Calibration { score_mean, score_spread } = objects.calibration;
            (score_mean + 3.0 * score_spread).clamp(-1.0, 1.0)
        }
        None => of_scene,
    };
    let threshold = settings
        .threshold
        .unwrap_or_else(|| objects.as_ref().map_or(of_scene, |o| query::mixed(of_scene, of_object(o))));
    let is_present = |word: &str| {
        let things = truth.things.iter().chain(&truth.background);
        things.into_iter().any(|t| t.category.contains(word) || t.words.iter().any(|w| w.contains(word)))
    };
    let mut abstained = [0, 0];
    for word in ABSENT.into_iter().filter(|word| !is_present(word)) {
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
            None => EvalError::NoCategories { categories: categories() },
        });
    }

    let superpoints = settings.filter.map(|_| Superpoints::new(scene, None, &SuperpointSettings::of_looks()));
    if let (Some(Filter::Mean), Some(superpoints)) = (settings.filter, &superpoints) {
        scores.iter_mut().for_each(|scores| filter::average(scores, superpoints));
    }

    // Retrieval counts the Gaussians of all things; argmax only those of the queried categories.
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
    let own_best = own_best::offsets(&scores);
    let confusion = |n_classes: usize, offsets: &[f32]| {
        let score = |class: usize, gaussian: usize| {
            scores[class][gaussian] - offsets.get(class).copied().unwrap_or_default()
        };
        let mut confusion = Confusion::new(n_classes);
        let best = |gaussian: usize| {
            (0..n_classes)
                .filter(|c| !scores[*c][gaussian].is_nan())
                .max_by(|a, b| score(*a, gaussian).total_cmp(&score(*b, gaussian)).then(b.cmp(a)))
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
    let whole = confusion(n_classes, &[]);
    let subsets = |offsets: &[f32]| -> Vec<Subset> {
        let sizes = std::iter::once(n_classes).chain(SUBSETS.into_iter().filter(|n| *n < n_classes));
        let subset = |n: usize| {
            let confusion = confusion(n, offsets);
            let (iou, accuracy) = (|c| confusion.iou(c), |c| confusion.accuracy(c));
            Subset { n_classes: n, miou: mean((0..n).map(iou)), macc: mean((0..n).map(accuracy)) }
        };
        sizes.map(subset).collect()
    };
    let n_without_evidence =
        of_things.iter().filter(|i| class_of(**i).is_some() && scores[0][**i].is_nan()).count();

    let instances = objects.as_ref().map(|objects| {
        let threshold = settings.threshold.unwrap_or_else(|| of_object(objects));
        instances::report(truth, &objects.object_of, objects.ids.len(), &classes, &of_objects, threshold)
    });
    let mut words = Vec::new();
    for (c, (word, ids)) in classes.iter().enumerate() {
        let positive: Vec<bool> = of_things.iter().map(|i| class_of(*i) == Some(c)).collect();
        // Gaussians without evidence rank below all others.
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
        kind: if objects.is_some() { EvalKind::Objects } else { EvalKind::Gaussians },
        instances,
        threshold,
        multi_class: subsets(&[]),
        multi_class_by_own_best: subsets(&own_best),
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
