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
            let [of_better, of_worse] = [better, worse].map(|mask| both_px / f64::from(mask.area_px()));
            let union_px = f64::from(better.area_px()) + f64::from(worse.area_px()) - both_px;
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
    use crate::masks::BoxPx;
    use crate::segment::sam::runs::{Run, RunMask};

    /// The rules of `mask_nms` in LangSplat's `preprocess.py`, restated over dense masks: matrices of IoU and of
    /// containment, their maxima by column, then the thresholds. Returns the kept masks, best first.
    fn langsplat(masks: &[Vec<bool>], scores: &[f64], filter: &ScoreFilter) -> Vec<usize> {
        let n = masks.len();
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by(|a, b| scores[*b].total_cmp(&scores[*a]));
        let area = |k: usize| masks[order[k]].iter().filter(|inside| **inside).count() as f64;
        let (mut iou_max, mut inner_max) = (vec![0.0f64; n], vec![0.0f64; n]);
        for i in 0..n {
            for j in i..n {
                let pairs = || masks[order[i]].iter().zip(&masks[order[j]]);
                let both = pairs().filter(|(a, b)| **a && **b).count() as f64;
                let either = pairs().filter(|(a, b)| **a || **b).count() as f64;
                if i < j {
                    iou_max[j] = iou_max[j].max(both / either);
                }
                let (of_i, of_j) = (both / area(i), both / area(j));
                if of_i < 0.5 && of_j >= 0.85 {
                    inner_max[j] = inner_max[j].max(1.0 - of_i * of_j);
                }
                if of_i >= 0.85 && of_j < 0.5 {
                    inner_max[i] = inner_max[i].max(1.0 - of_i * of_j);
                }
            }
        }
        let mut confident: Vec<bool> = order.iter().map(|k| scores[*k] > filter.min_score).collect();
        if confident.iter().all(|is| !is) {
            confident.iter_mut().take(3).for_each(|is| *is = true);
        }
        let keeps = |k: &usize| {
            confident[*k] && iou_max[*k] <= filter.max_iou && inner_max[*k] <= 1.0 - filter.max_contained
        };
        (0..n).filter(keeps).map(|k| order[k]).collect()
    }

    #[test]
    fn the_score_filter_equals_langsplats_rules() {
        const EDGE: u32 = 48;
        let mut state = 11u64;
        let mut random = move |n: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) % n
        };
        let (mut n_kept, mut n_all, mut n_contained) = (0, 0, 0);
        for round in 0..60 {
            // Boxes that repeat, nearly repeat and contain each other. In some rounds no score is above the
            // threshold.
            let mut boxes: Vec<[u32; 4]> = Vec::new();
            for _ in 0..2 + random(14) {
                let (x, y) = (random(30) as u32, random(30) as u32);
                let fresh = [x, y, x + 2 + random(16) as u32, y + 2 + random(16) as u32];
                let made = match (boxes.last(), random(3)) {
                    (Some([x0, y0, x1, y1]), 0) => [*x0, *y0, *x1, (y1 + 1).min(EDGE)],
                    (Some([x0, y0, x1, y1]), 1) => {
                        [*x0, *y0, x0 + (x1 - x0).div_ceil(2), y0 + (y1 - y0).div_ceil(2)]
                    }
                    _ => fresh,
                };
                boxes.push(made);
            }
            let highest = if round % 6 == 0 { 0.7 } else { 1.0 };
            let candidates: Vec<Candidate> = boxes
                .iter()
                .map(|[x0, y0, x1, y1]| {
                    let runs = (*y0..*y1).map(|y| Run { y, x0: *x0, x1: *x1 }).collect();
                    Candidate {
                        mask: RunMask::new(runs).expect("not empty"),
                        predicted_iou: (highest * (0.6 + 0.4 * random(1000) as f64 / 1000.0)) as f32,
                        stability: 0.7 + 0.3 * random(1000) as f64 / 1000.0,
                        level: 0,
                        crop: BoxPx { x0: 0, y0: 0, x1: EDGE, y1: EDGE },
                    }
                })
                .collect();
            let dense: Vec<Vec<bool>> = boxes
                .iter()
                .map(|[x0, y0, x1, y1]| {
                    let inside =
                        |at: u32| (*x0..*x1).contains(&(at % EDGE)) && (*y0..*y1).contains(&(at / EDGE));
                    (0..EDGE * EDGE).map(inside).collect()
                })
                .collect();
            let scores: Vec<f64> =
                candidates.iter().map(|c| f64::from(c.predicted_iou) * c.stability).collect();
            let expected = langsplat(&dense, &scores, &ScoreFilter::LANGSPLAT);
            let found = keep(candidates.clone(), &ScoreFilter::LANGSPLAT);
            let expected: Vec<&RunMask> = expected.iter().map(|k| &candidates[*k].mask).collect();
            assert_eq!(
                found.iter().map(|candidate| &candidate.mask).collect::<Vec<_>>(),
                expected,
                "round {round}"
            );
            let never = ScoreFilter { max_contained: 0.0, ..ScoreFilter::LANGSPLAT };
            n_contained += keep(candidates, &never).len() - found.len();
            (n_kept, n_all) = (n_kept + found.len(), n_all + boxes.len());
        }
        println!("{n_kept} of {n_all} stay; {n_contained} go because another mask contains them");
        assert!(n_kept > 100 && n_contained > 20 && n_kept < n_all / 2 + 100);
    }
}
