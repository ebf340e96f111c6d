//! The choice of views that together show most.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::looks::Look;

/// Gain of a Gaussian's first, second, third and further view, tenths.
const GAINS: [u32; 4] = [10, 6, 4, 1];
/// Gain from a side that no view has shown yet, and from one that a view has shown, fifths.
const NEW_SIDE: u32 = 5;
const USED_SIDE: u32 = 2;

/// How often a Gaussian is seen, and from which sides.
#[derive(Clone, Copy, Default)]
struct Seen {
    n_views: u8,
    sides: u8,
}

impl Seen {
    fn gain(self, side: u8) -> u32 {
        let gain = GAINS[usize::from(self.n_views).min(GAINS.len() - 1)];
        gain * if self.sides & (1 << side) == 0 { NEW_SIDE } else { USED_SIDE }
    }
}

/// Returns at most `n_views` looks, each the one that gains most after those before it, and the share of the Gaussians
/// seen by any look that they see. Ties go to the first. Gains only fall, so most need not be computed again (Minoux
/// 1978).
pub(super) fn greedy(looks: &[Look], n_gaussians: usize, n_views: usize) -> (Vec<usize>, f64) {
    let mut state = vec![Seen::default(); n_gaussians];
    let gain = |state: &[Seen], look: &Look| -> u64 {
        look.seen.iter().map(|(gaussian, side)| u64::from(state[*gaussian as usize].gain(*side))).sum()
    };
    // (gain, first look, how many were chosen when the gain was computed)
    let mut heap: BinaryHeap<_> =
        looks.iter().enumerate().map(|(at, look)| (gain(&state, look), Reverse(at), 0)).collect();
    let mut chosen = Vec::new();
    while chosen.len() < n_views
        && let Some((_, Reverse(at), n_then)) = heap.pop()
    {
        if n_then != chosen.len() {
            heap.push((gain(&state, &looks[at]), Reverse(at), chosen.len()));
            continue;
        }
        for (gaussian, side) in &looks[at].seen {
            let seen = &mut state[*gaussian as usize];
            seen.n_views = seen.n_views.saturating_add(1);
            seen.sides |= 1 << side;
        }
        chosen.push(at);
    }
    let mut by_any = vec![false; n_gaussians];
    looks.iter().flat_map(|look| &look.seen).for_each(|(gaussian, _)| by_any[*gaussian as usize] = true);
    let n_any = by_any.iter().filter(|seen| **seen).count();
    let n_seen = state.iter().filter(|seen| seen.n_views > 0).count();
    (chosen, n_seen as f64 / n_any.max(1) as f64)
}
