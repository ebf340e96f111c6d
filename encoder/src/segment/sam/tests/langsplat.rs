//! LangSplat's own filter, run on made masks and recorded.
//!
//! `langsplat_mask_nms.json` has 24 sets of rectangles and ellipses with scores, and what LangSplat's
//! `masks_update` kept of each with the thresholds of its `sam_encoder`. None of its code is here.

use super::*;
use serde::Deserialize;

use crate::segment::sam::ScoreFilter;
use crate::segment::sam::filter::{Candidate, keep_by_score};
use crate::segment::sam::runs::{Run, RunMask};

#[derive(Deserialize)]
struct Recorded {
    thresholds: Thresholds,
    width_px: u32,
    height_px: u32,
    sets: Vec<Set>,
}

#[derive(Deserialize)]
struct Thresholds {
    iou_thr: f64,
    score_thr: f64,
    inner_thr: f64,
}

#[derive(Deserialize)]
struct Set {
    kept: Vec<usize>,
    masks: Vec<Mask>,
}

#[derive(Deserialize)]
struct Mask {
    shape: String,
    at: [i64; 4],
    predicted_iou: f32,
    stability: f64,
}

impl Mask {
    /// Whether a pixel lies in `x0 y0 x1 y1` of a rectangle, or its centre in `x y rx ry` of an ellipse.
    fn contains(&self, x: u32, y: u32) -> bool {
        let ([a, b, c, d], x, y) = (self.at, i64::from(x), i64::from(y));
        match self.shape.as_str() {
            "rectangle" => (a..c).contains(&x) && (b..d).contains(&y),
            _ => {
                let (dx, dy) = (2 * x + 1 - 2 * a, 2 * y + 1 - 2 * b);
                dx * dx * d * d + dy * dy * c * c <= 4 * c * c * d * d
            }
        }
    }

    fn runs(&self, width_px: u32, height_px: u32) -> Vec<Run> {
        let mut runs: Vec<Run> = Vec::new();
        for y in 0..height_px {
            for x in (0..width_px).filter(|x| self.contains(*x, y)) {
                match runs.last_mut() {
                    Some(run) if run.y == y && run.x1 == x => run.x1 += 1,
                    _ => runs.push(Run { y, x0: x, x1: x + 1 }),
                }
            }
        }
        runs
    }
}

#[test]
fn the_score_filter_keeps_what_langsplats_own_code_keeps() {
    let recorded: Recorded = serde_json::from_str(include_str!("langsplat_mask_nms.json")).expect("recorded");
    let Thresholds { iou_thr, score_thr, inner_thr } = recorded.thresholds;
    let filter = ScoreFilter::LANGSPLAT;
    assert_eq!((filter.max_iou, filter.min_score, filter.max_contained), (iou_thr, score_thr, inner_thr));
    let (mut n_masks, mut n_kept) = (0, 0);
    for (at, set) in recorded.sets.iter().enumerate() {
        let (width_px, height_px) = (recorded.width_px, recorded.height_px);
        let candidates: Vec<Candidate> = set
            .masks
            .iter()
            .map(|mask| Candidate {
                mask: RunMask::new(mask.runs(width_px, height_px)).expect("not empty"),
                predicted_iou: mask.predicted_iou,
                stability: mask.stability,
                level: 0,
                crop: BoxPx { x0: 0, y0: 0, x1: width_px, y1: height_px },
            })
            .collect();
        // Scores identify the masks of a set. LangSplat keeps the order of masks, ours go by score.
        let of = |score: f64| {
            candidates.iter().position(|c| c.score().total_cmp(&score).is_eq()).expect("one of them")
        };
        let mut kept: Vec<usize> =
            keep_by_score(candidates.clone(), &filter).iter().map(|c| of(c.score())).collect();
        kept.sort_unstable();
        assert_eq!(kept, set.kept, "set {at}");
        (n_masks, n_kept) = (n_masks + candidates.len(), n_kept + kept.len());
    }
    assert_eq!((recorded.sets.len(), n_masks, n_kept), (24, 212, 71));
}
