//! LangSplat's last filter of the masks of one level (Qin et al. 2024, `mask_nms` of `preprocess.py`).

use super::candidate::Candidate;
use super::settings::ScoreFilter;

/// A mask is contained if at least this share of it lies in another one ...
const CONTAINED_SHARE: f64 = 0.85;
/// ... of which it covers less than this share.
const LARGE_SHARE: f64 = 0.5;
/// Masks that stay where no score is above the threshold.
const N_BEST: usize = 3;

/// Returns the masks that stay, the one with the highest score first; equal scores in their order.
///
/// Unlike greedy suppression, a mask counts against others even where it is dropped itself.
pub(super) fn keep(mut candidates: Vec<Candidate>, filter: &ScoreFilter) -> Vec<Candidate> {
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
