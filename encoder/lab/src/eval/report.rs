//! The figures of an evaluation against labels, as JSON and as a table.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;
use slag_common::shard::Profile;

use super::filter::Filter;
use super::instances::InstanceReport;
use super::settings::EvalKind;

/// Figures of a word.
#[derive(Clone, Debug, Serialize)]
pub struct WordReport {
    /// The category.
    pub word: String,
    /// Gaussians with this label.
    pub n_gaussians: usize,
    /// Intersection over union of the argmax over all words.
    pub iou: Option<f64>,
    /// Share of its Gaussians that the argmax assigns to it.
    pub accuracy: Option<f64>,
    /// Intersection over union of the Gaussians above the threshold, among all things.
    pub iou_at_threshold: Option<f64>,
    /// Average precision among all things.
    pub average_precision: Option<f64>,
    /// Area under the ROC curve among all things.
    pub area_under_roc: Option<f64>,
    /// Share of the test views with the thing on which the best pixel lies on it.
    pub localised: Option<f64>,
    /// Intersection over union of the pixels above the threshold, on test views.
    pub iou_on_views: Option<f64>,
    /// Test views that show the thing.
    pub n_views: usize,
}

/// Means over a list of classes.
#[derive(Clone, Debug, Serialize)]
pub struct Subset {
    /// Number of classes.
    pub n_classes: usize,
    /// Mean intersection over union.
    pub miou: Option<f64>,
    /// Mean accuracy.
    pub macc: Option<f64>,
}

/// Figures of an evaluation.
#[derive(Clone, Debug, Serialize)]
pub struct EvalReport {
    /// The store's encoder.
    pub encoder: String,
    /// Profile of the scored shards; absent for the full field.
    pub profile: Option<Profile>,
    /// How the Gaussians of a superpoint answered together; absent where each answered for itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub filter: Option<Filter>,
    /// What was scored.
    pub kind: EvalKind,
    /// Whether each level of masks was scored separately.
    pub by_mask_level: bool,
    /// Instance recall; only where objects were scored.
    pub instances: Option<InstanceReport>,
    /// Lowest score of a match.
    pub threshold: f32,
    /// Each word.
    pub words: Vec<WordReport>,
    /// All classes, and the largest ones.
    pub multi_class: Vec<Subset>,
    /// The same, with words compared by how near a score is to the word's own best ones (`own_best`).
    pub multi_class_by_own_best: Vec<Subset>,
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
    /// Negative queries: how many found nothing, and how many there were.
    pub abstained: [usize; 2],
    /// Words that the encoder cannot encode, and why; no mean counts them.
    pub unknown_words: BTreeMap<String, String>,
    /// Gaussians of the words' things without an embedding; they count as wrong.
    pub n_without_evidence: usize,
    /// Gaussians that belong to no thing; they are not counted.
    pub n_unlabelled: usize,
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
        for (s, own) in self.multi_class.iter().zip(&self.multi_class_by_own_best) {
            write!(f, "{} classes: mIoU {}, mAcc {}; ", s.n_classes, show(s.miou), show(s.macc))?;
            writeln!(f, "by each word's own best scores {}, {}", show(own.miou), show(own.macc))?;
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
        writeln!(f, "negative queries: {} of {} found nothing", self.abstained[0], self.abstained[1])?;
        if let Some(found) = &self.instances {
            let InstanceReport { n_objects, n_merged_objects, n_split_things, any, of_words, best_of_words } =
                found;
            writeln!(f, "{n_objects} objects; instance recall at IoU 0.25 and 0.5, by any object: {any}")?;
            writeln!(
                f,
                "  objects that are two things: {n_merged_objects}; things that are two objects: {n_split_things}"
            )?;
            writeln!(
                f,
                "  by objects above the threshold for the word: {of_words}; by the word's best objects: {best_of_words}"
            )?;
        }
        if !self.unknown_words.is_empty() {
            let words: Vec<&str> = self.unknown_words.keys().map(String::as_str).collect();
            writeln!(f, "unknown to the encoder and left out of the means: {}", words.join(", "))?;
        }
        writeln!(
            f,
            "{} Gaussians without evidence count as wrong, {} without a label are left out",
            self.n_without_evidence, self.n_unlabelled
        )
    }
}
