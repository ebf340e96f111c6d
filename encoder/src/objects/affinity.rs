//! How much masks speak for two superpoints being of one object.
//!
//! In a view that sees both, it is the share of the masks of either that show both: segmenters return wholes and
//! parts side by side, so an object's superpoints share its mask and those of all that contains it, and
//! superpoints of two objects only the latter. Yin et al. ("SAI3D", CVPR 2024) join superpoints by masks, too, of
//! one level.

use std::cmp::Ordering;

use rayon::prelude::*;

use super::sightings::{MaskSighting, Sightings, ViewSighting};

/// A mask shows a superpoint if it has at least this share of its Gaussians that the view sees, in halves.
const INSIDE_HALVES: u32 = 1;
/// Affinity without evidence, and the Gaussians that it counts for.
const PRIOR: f64 = 0.3;
const PRIOR_WEIGHT: f64 = 1.0;
/// A share of 1.
pub(super) const SHARE: u64 = 1 << 20;

/// What views say about two superpoints, or two sets of them; evidence is added. Integers, so that sums do not
/// depend on their order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Evidence {
    /// Sum over the views of the share of masks that show both, in units of [`SHARE`], times Gaussians.
    pub(super) together: u64,
    /// Sum over the views of the Gaussians of the smaller one.
    pub(super) n: u64,
}

impl Evidence {
    /// Returns the affinity, 0..=1.
    pub(super) fn affinity(&self) -> f64 {
        (self.together as f64 / SHARE as f64 + PRIOR * PRIOR_WEIGHT) / (self.n as f64 + PRIOR_WEIGHT)
    }
}

impl std::ops::AddAssign for Evidence {
    fn add_assign(&mut self, other: Self) {
        // A share takes 20 bits: thousands of views of billions of Gaussians are the limit.
        self.together = self.together.saturating_add(other.together);
        self.n = self.n.saturating_add(other.n);
    }
}

/// Returns the evidence of each pair; pairs that no mask shows together are left out.
pub(super) fn of_pairs(sightings: &Sightings, pairs: &[(u32, u32)]) -> Vec<(u32, u32, Evidence)> {
    let of_pair = |(a, b): &(u32, u32)| (*a, *b, of_pair(sightings, *a as usize, *b as usize));
    pairs.par_iter().map(of_pair).filter(|(_, _, evidence)| evidence.together > 0).collect()
}

fn of_pair(sightings: &Sightings, a: usize, b: usize) -> Evidence {
    let mut evidence = Evidence::default();
    let (mut of_a, mut of_b) = (sightings.of(a).peekable(), sightings.of(b).peekable());
    while let (Some(a), Some(b)) = (of_a.peek(), of_b.peek()) {
        match a.view.cmp(&b.view) {
            Ordering::Less => drop(of_a.next()),
            Ordering::Greater => drop(of_b.next()),
            Ordering::Equal => {
                let (n_both, n_either) = shared(a, b);
                // A view with no mask of either is no evidence.
                if let Some(share) = (n_both * SHARE).checked_div(n_either) {
                    let n = u64::from(a.n.min(b.n));
                    evidence += Evidence { together: n * share, n };
                }
                of_a.next();
                of_b.next();
            }
        }
    }
    evidence
}

/// Returns the number of masks that show both superpoints, and of those that show either; none where a view sees
/// one alone.
fn shared(a: &ViewSighting<'_>, b: &ViewSighting<'_>) -> (u64, u64) {
    if a.n == 0 || b.n == 0 {
        return (0, 0);
    }
    let inside = |of_view: &ViewSighting<'_>| {
        let n = of_view.n;
        move |of_mask: &&MaskSighting| of_mask.n > 0 && of_mask.n * 2 >= n * INSIDE_HALVES
    };
    let n_a = a.masks.iter().filter(inside(a)).count();
    let n_b = b.masks.iter().filter(inside(b)).count();
    let is_of_b = |of_a: &&MaskSighting| {
        let at = b.masks.binary_search_by_key(&of_a.mask, |of_b| of_b.mask);
        at.is_ok_and(|at| inside(b)(&&b.masks[at]))
    };
    let n_both = a.masks.iter().filter(inside(a)).filter(is_of_b).count();
    (n_both as u64, (n_a + n_b - n_both) as u64)
}
