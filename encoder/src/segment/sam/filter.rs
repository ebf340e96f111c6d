//! The settings and the filters of Segment Anything's automatic mask generation, in their order.

use rayon::prelude::*;
use slag_models::sam::{Decoded, MASKS_PER_PROMPT};

use super::runs::RunMask;
use super::upsample::Upsampler;
use crate::masks::BoxPx;

/// Which of the three masks of a prompt are used.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum,
)]
#[serde(rename_all = "lowercase")]
pub enum SamLevels {
    /// All three in one list: a duplicate goes, whatever its level, as in the reference implementation.
    #[default]
    Merged,
    /// The largest.
    Whole,
    Part,
    /// The smallest.
    Subpart,
    /// All three, each level filtered by itself, as LangSplat does.
    All,
}

impl SamLevels {
    /// Levels of each separately filtered list: 0 whole, 1 part, 2 subpart.
    pub(super) fn lists(self) -> &'static [&'static [u8]] {
        match self {
            Self::Merged => &[&[0, 1, 2]],
            Self::Whole => &[&[0]],
            Self::Part => &[&[1]],
            Self::Subpart => &[&[2]],
            Self::All => &[&[0], &[1], &[2]],
        }
    }
}

/// Thresholds of LangSplat's filter. A mask's score is its predicted IoU times its stability.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ScoreFilter {
    /// Masks need a score above this; where none has it, the best three stay.
    pub min_score: f64,
    /// A mask goes if its IoU with one of a higher score is above this.
    pub max_iou: f64,
    /// A mask of which at least 85 % lie in another one, of which it covers less than half, goes if the product of
    /// the two shares is below this.
    pub max_contained: f64,
}

impl ScoreFilter {
    pub const LANGSPLAT: Self = Self { min_score: 0.7, max_iou: 0.8, max_contained: 0.5 };
}

/// Settings for the prompts and the filters of masks. The defaults are those of the reference implementation.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SamSettings {
    pub points_per_side: u32,
    /// Points that the decoder processes at once. Memory: 0.8 MB per point, twice.
    pub points_per_batch: u32,
    /// Masks need a predicted IoU above this; 0 keeps all masks.
    pub predicted_iou: f32,
    /// Least IoU between the masks thresholded at logits of plus and minus `stability_offset`.
    pub stability: f64,
    /// Offset of the thresholds for `stability`, logits.
    pub stability_offset: f32,
    /// Of two masks in a crop with a box IoU above this, the one with the higher predicted IoU is kept.
    pub box_nms_iou: f64,
    /// The same for the pixel IoU of all masks, at the end; 1 compares none, like the reference implementation.
    pub mask_nms_iou: f64,
    /// Layers of crops in addition to the whole image; layer `i` has 4^i crops.
    pub crop_layers: u32,
    /// Of two masks in different crops with a box IoU above this, the one in the smaller crop is kept.
    pub crop_nms_iou: f64,
    /// Overlap of neighbouring crops of the first layer, relative to the shorter edge of the image.
    pub crop_overlap: f64,
    /// Divisor of the points per side from layer to layer.
    pub crop_points_divisor: u32,
    /// Which of the three masks of a prompt are used.
    pub levels: SamLevels,
    /// LangSplat's filter at the end, for each level by itself.
    pub score_filter: Option<ScoreFilter>,
    /// Holes are filled and islands removed if they have fewer pixels; 0 keeps all.
    pub min_region_px: u32,
}

impl Default for SamSettings {
    fn default() -> Self {
        Self {
            points_per_side: 32,
            points_per_batch: 64,
            predicted_iou: 0.88,
            stability: 0.95,
            stability_offset: 1.0,
            box_nms_iou: 0.7,
            mask_nms_iou: 1.0,
            crop_layers: 0,
            crop_nms_iou: 0.7,
            crop_overlap: 512.0 / 1500.0,
            crop_points_divisor: 1,
            min_region_px: 0,
            levels: SamLevels::Merged,
            score_filter: None,
        }
    }
}

impl SamSettings {
    /// The paper's: LangSplat's mask generator (Qin et al. 2024, `preprocess.py`) on a grid of 16 x 16 points, whole
    /// level only.
    pub fn paper() -> Self {
        Self {
            points_per_side: 16,
            predicted_iou: 0.7,
            stability: 0.85,
            crop_layers: 1,
            min_region_px: 100,
            levels: SamLevels::Whole,
            score_filter: Some(ScoreFilter::LANGSPLAT),
            ..Self::default()
        }
    }
}

/// A box this near to an edge touches it, as in the reference implementation.
const EDGE_TOLERANCE_PX: u32 = 20;
/// A mask is contained if at least this share of it lies in another one ...
const CONTAINED_SHARE: f64 = 0.85;
/// ... of which it covers less than this share.
const LARGE_SHARE: f64 = 0.5;
/// Masks that stay if no score is above the threshold.
const N_BEST: usize = 3;

#[derive(Clone, Debug)]
pub(super) struct Candidate {
    pub(super) mask: RunMask,
    /// Predicted by the model.
    pub(super) predicted_iou: f32,
    /// IoU of the mask with itself under a higher and a lower threshold.
    pub(super) stability: f64,
    /// 0 whole, 1 part, 2 subpart.
    pub(super) level: u8,
    /// Crop of the image in which the mask was found.
    pub(super) crop: BoxPx,
}

impl Candidate {
    pub(super) fn score(&self) -> f64 {
        f64::from(self.predicted_iou) * self.stability
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Filters<'a> {
    pub(super) settings: &'a SamSettings,
    pub(super) image_px: [u32; 2],
}

impl Filters<'_> {
    /// Proposals, in order, of prompts that show an object, with a sufficient predicted IoU, stable, and not cut by the
    /// crop.
    pub(super) fn candidates(&self, decoded: &Decoded, upsampler: &Upsampler, crop: BoxPx) -> Vec<Candidate> {
        let SamSettings { predicted_iou: least_iou, stability, stability_offset, .. } = *self.settings;
        let n_logits = (decoded.logits_px[0] * decoded.logits_px[1]) as usize;
        let lists = self.settings.levels.lists();
        // Three proposals per prompt, smallest first.
        let level_of = |at: usize| (MASKS_PER_PROMPT - 1 - at % MASKS_PER_PROMPT) as u8;
        let proposals = decoded.logits.par_chunks_exact(n_logits).zip(&decoded.predicted_ious).enumerate();
        // SAM 2's own rule: an object has a logit above 0.
        let shows_object =
            |at: usize| decoded.object_logits.get(at / MASKS_PER_PROMPT).is_none_or(|&logit| logit > 0.0);
        proposals
            .filter(|(at, _)| shows_object(*at))
            .filter(|(at, _)| lists.iter().any(|list| list.contains(&level_of(*at))))
            .filter(|&(_, (_, &predicted_iou))| predicted_iou > least_iou || least_iou == 0.0)
            .filter_map(|(at, (logits, predicted_iou))| {
                let cut = upsampler.cut(logits, stability_offset, [crop.x0, crop.y0])?;
                let keeps = cut.stability >= stability && !self.is_cut_by(crop, cut.mask.box_px);
                let (mask, stability) = (cut.mask, cut.stability);
                let candidate =
                    Candidate { mask, predicted_iou: *predicted_iou, stability, level: level_of(at), crop };
                keeps.then_some(candidate)
            })
            .collect()
    }

    /// Whether a box touches an edge of the crop that is no edge of the image.
    fn is_cut_by(&self, crop: BoxPx, found: BoxPx) -> bool {
        // The last column and row are inclusive, as in the reference implementation.
        let edges = |b: BoxPx| [b.x0, b.y0, b.x1, b.y1];
        let found = [found.x0, found.y0, found.x1 - 1, found.y1 - 1];
        let image = [0, 0, self.image_px[0], self.image_px[1]];
        let is_near = |a: u32, b: u32| a.abs_diff(b) <= EDGE_TOLERANCE_PX;
        found
            .into_iter()
            .zip(edges(crop))
            .zip(image)
            .any(|((found, crop), image)| is_near(found, crop) && !is_near(found, image))
    }

    pub(super) fn lists(&self, candidates: Vec<Candidate>) -> Vec<Vec<Candidate>> {
        let lists = self.settings.levels.lists();
        let mut found = vec![Vec::new(); lists.len()];
        for candidate in candidates {
            if let Some(at) = lists.iter().position(|list| list.contains(&candidate.level)) {
                found[at].push(candidate);
            }
        }
        found
    }

    /// Drops duplicates within a crop, keeping the higher predicted IoU.
    pub(super) fn unique_in_crop(&self, candidates: Vec<Candidate>) -> Vec<Candidate> {
        let scores = candidates.iter().map(|candidate| f64::from(candidate.predicted_iou)).collect();
        by_boxes(candidates, scores, self.settings.box_nms_iou)
    }

    /// Drops duplicates between crops, removes small holes and islands, drops duplicates by box and by pixels, and
    /// applies LangSplat's filter if the settings ask for it.
    pub(super) fn unique_in_image(&self, mut candidates: Vec<Candidate>, n_crops: usize) -> Vec<Candidate> {
        let SamSettings { box_nms_iou, crop_nms_iou, mask_nms_iou, min_region_px, score_filter, .. } =
            *self.settings;
        if n_crops > 1 {
            // Smaller crops show more detail.
            let scores = candidates.iter().map(|candidate| 1.0 / candidate.crop.area_px() as f64).collect();
            candidates = by_boxes(candidates, scores, crop_nms_iou);
        }
        if min_region_px > 0 {
            let [width_px, height_px] = self.image_px;
            let heal = |candidate: &mut Candidate| {
                let healed = candidate.mask.without_small_regions(width_px, height_px, min_region_px);
                // Unchanged masks have priority.
                let score = f64::from(u8::from(healed.is_none()));
                if let Some(healed) = healed {
                    candidate.mask = healed;
                }
                score
            };
            let scores = candidates.par_iter_mut().map(heal).collect();
            candidates = by_boxes(candidates, scores, box_nms_iou.max(crop_nms_iou));
        }
        if mask_nms_iou < 1.0 {
            let scores = candidates.iter().map(|candidate| f64::from(candidate.predicted_iou)).collect();
            candidates = suppress(candidates, scores, |a, b| a.mask.iou(&b.mask) > mask_nms_iou);
        }
        match score_filter {
            Some(filter) => keep_by_score(candidates, &filter),
            None => candidates,
        }
    }
}

/// Whether all logits and scores are finite: others are on neither side of a threshold.
pub(super) fn is_finite(decoded: &Decoded) -> bool {
    let Decoded { predicted_ious, object_logits, logits, .. } = decoded;
    let scores = predicted_ious.iter().chain(object_logits);
    logits.par_chunks(1 << 16).all(|part| part.iter().all(|x| x.is_finite()))
        && scores.into_iter().all(|x| x.is_finite())
}

fn by_boxes(candidates: Vec<Candidate>, scores: Vec<f64>, most_iou: f64) -> Vec<Candidate> {
    suppress(candidates, scores, |a, b| box_iou(a.mask.box_px, b.mask.box_px) > most_iou)
}

/// Non-maximum suppression: in descending order of scores (equal ones in order), keeps candidates that duplicate no
/// kept one.
fn suppress(
    candidates: Vec<Candidate>,
    scores: Vec<f64>,
    is_duplicate: impl Fn(&Candidate, &Candidate) -> bool + Sync,
) -> Vec<Candidate> {
    let mut ranked: Vec<(f64, Candidate)> = scores.into_iter().zip(candidates).collect();
    ranked.sort_by(|(a, _), (b, _)| b.total_cmp(a));
    let mut kept: Vec<Candidate> = Vec::new();
    for (_, candidate) in ranked {
        if !kept.par_iter().any(|better| is_duplicate(better, &candidate)) {
            kept.push(candidate);
        }
    }
    kept
}

/// IoU of two boxes as in the reference implementation, where areas exclude the last row and column; NaN for two lines.
fn box_iou(a: BoxPx, b: BoxPx) -> f64 {
    let area = |b: BoxPx| f64::from(b.width_px() - 1) * f64::from(b.height_px() - 1);
    let overlap = |low: u32, high: u32| f64::from(high.saturating_sub(low + 1));
    let both = overlap(a.x0.max(b.x0), a.x1.min(b.x1)) * overlap(a.y0.max(b.y0), a.y1.min(b.y1));
    both / (area(a) + area(b) - both)
}

/// LangSplat's last filter of one level's masks (Qin et al. 2024, `mask_nms` of `preprocess.py`), best score first;
/// equal scores in order. Unlike greedy suppression, a dropped mask still counts against others.
pub(super) fn keep_by_score(mut candidates: Vec<Candidate>, filter: &ScoreFilter) -> Vec<Candidate> {
    candidates.sort_by(|a, b| b.score().total_cmp(&a.score()));
    let mut keeps: Vec<bool> = candidates.iter().map(|mask| mask.score() > filter.min_score).collect();
    if !keeps.contains(&true) {
        keeps.iter_mut().take(N_BEST).for_each(|keeps| *keeps = true);
    }
    for j in 1..candidates.len() {
        for i in 0..j {
            let [better, worse] = [i, j].map(|k| &candidates[k].mask);
            let both_px = better.intersection_px(worse) as f64;
            let [of_better, of_worse] = [better, worse].map(|mask| both_px / f64::from(mask.area_px));
            let union_px = f64::from(better.area_px) + f64::from(worse.area_px) - both_px;
            let is_contained = |share: f64, of_other: f64| {
                share >= CONTAINED_SHARE && of_other < LARGE_SHARE && share * of_other < filter.max_contained
            };
            keeps[j] &= both_px / union_px <= filter.max_iou && !is_contained(of_worse, of_better);
            keeps[i] &= !is_contained(of_better, of_worse);
        }
    }
    candidates.into_iter().zip(keeps).filter(|(_, keeps)| *keeps).map(|(mask, _)| mask).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logits_and_scores_that_are_no_numbers_are_noticed() {
        let decoded = Decoded {
            predicted_ious: vec![0.9; 3],
            object_logits: vec![1.0],
            logits: vec![-1.0; 27].into(),
            logits_px: [3, 3],
        };
        assert!(is_finite(&decoded));
        let mut logits = vec![-1.0; 27];
        logits[26] = f32::NAN;
        assert!(!is_finite(&Decoded { logits: logits.into(), ..decoded.clone() }));
        assert!(!is_finite(&Decoded { predicted_ious: vec![f32::NAN; 3], ..decoded.clone() }));
        assert!(!is_finite(&Decoded { object_logits: vec![f32::INFINITY], ..decoded }));
    }
}
