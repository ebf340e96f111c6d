//! Which nodes of the tree are objects: those that views agree on.
//!
//! A view's agreement with a node is the best intersection over union of one of its masks with what it sees of the
//! node. A node's consensus is the mean agreement of the views that see enough of it (as MaskClustering, Yan et al.,
//! CVPR 2024, judges masks); masks cut off by the photo's edge and views from afar count less. The nodes are chosen,
//! none part of another, with the largest sum of consensus^8 n^(1/4), n the number of Gaussians: an object wins over
//! its parts if views agree on it nearly as well.
//!
//! A node that no photo shows whole is no object: each photo's mask of a road agrees with what the photo sees of it,
//! and none tells where it ends. Nor is a wide patch of ground, as from high above photos show whole roads.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::sightings::{Sightings, ViewSighting};
use super::tree::Tree;
use crate::ground::{Footprint, Standing};

/// Least share of a node, in tenths, that a judging view sees: one side is enough. What it sees without an outline is
/// in none of its masks.
const OBSERVED_TENTHS: u64 = 1;
/// Nodes below this consensus are no objects.
const MIN_CONSENSUS: f64 = 0.3;
/// A mask with a larger intersection over union shows the node: a majority of their union, so that no mask shows two
/// disjoint nodes.
const SAME_IOU: f64 = 0.5;
/// Uncut share of a mask's outline from which a view begins to show a node whole, and from which it does: indoors,
/// photos of a wardrobe cut its top or its feet.
const NEARLY_WHOLE: f64 = 0.75;
const WHOLE: f64 = 0.9;
/// Least share of an object, in tenths, that such a view sees: photos of ground show and outline a patch of it.
const WHOLE_TENTHS: u64 = 2;
/// One in this many judging views must show an object whole: a car park that 2 of 39 photos outline is none.
const JUDGES_PER_WHOLE: f64 = 11.0;
/// Factor of agreement with a mask of a standing thing: all views agree on it, also where things touch.
const STANDING_TRUST: f64 = 0.75;
/// Views of fewer pixels count proportionally less: one pixel of error spoils a small outline.
const FULL_PX: f64 = 4096.0;
/// A view counts the square of its mask's uncut share of outline, and at least the square of this.
const LEAST_UNCUT: f32 = 0.05;

#[derive(Clone, Debug, Default, PartialEq)]
struct NodeView {
    /// Gaussians that the view sees.
    n: u32,
    weight_px: f64,
    /// Of these, the Gaussians under each mask.
    masks: BTreeMap<u32, u32>,
    /// Best intersection over union of a mask.
    agreement: f64,
    /// Uncut share of that mask's outline; 1 without one.
    uncut: f32,
}

type NodeViews = BTreeMap<u32, NodeView>;

#[derive(Clone, Copy)]
pub(super) struct Sizes<'a> {
    /// `[n_masks]`: sightings under each mask.
    pub(super) of_masks: &'a [u32],
    /// `[n_masks]`: 1 - truncation.
    pub(super) uncut_shares: &'a [f32],
    /// `[n_masks]`: masks of standing things.
    pub(super) is_standing: &'a [bool],
    /// `[n]`: Gaussians of each superpoint.
    pub(super) of_superpoints: &'a [u32],
    /// `[n]`: ground that each superpoint covers; empty without any.
    pub(super) footprints: &'a [Footprint],
    pub(super) standing: &'a Standing,
    pub(super) min_gaussians: u32,
}

impl NodeView {
    fn of(of_view: &ViewSighting<'_>) -> Self {
        let masks = of_view.masks.iter().filter(|of| of.n > 0).map(|of| (of.mask, of.n)).collect();
        Self { n: of_view.n, weight_px: of_view.weight_px, masks, agreement: 0.0, uncut: 1.0 }
    }

    /// Adds what the view shows of other Gaussians.
    fn add(&mut self, other: Self) {
        self.n += other.n;
        self.weight_px += other.weight_px;
        other.masks.into_iter().for_each(|(mask, n)| *self.masks.entry(mask).or_default() += n);
    }

    fn ious(&self, n_of_mask: &[u32]) -> impl Iterator<Item = (u32, f64)> {
        self.masks.iter().map(|(mask, both)| {
            let union = u64::from(self.n) + u64::from(n_of_mask[*mask as usize]) - u64::from(*both);
            (*mask, f64::from(*both) / union as f64)
        })
    }

    fn judge(&mut self, sizes: Sizes<'_>) {
        let trust = |mask: u32| if sizes.is_standing[mask as usize] { STANDING_TRUST } else { 1.0 };
        let trusted = self.ious(sizes.of_masks).map(|(mask, iou)| (mask, iou * trust(mask)));
        let best = trusted.reduce(|best, other| if other.1 > best.1 { other } else { best });
        (self.agreement, self.uncut) =
            best.map_or((0.0, 1.0), |(mask, iou)| (iou, sizes.uncut_shares[mask as usize]));
    }
}

fn views_of(sightings: &Sightings, superpoint: usize, sizes: Sizes<'_>) -> NodeViews {
    let of_view = |of_view: ViewSighting<'_>| {
        let mut view = NodeView::of(&of_view);
        view.judge(sizes);
        (of_view.view, view)
    };
    sightings.of(superpoint).filter(|of_view| of_view.n > 0).map(of_view).collect()
}

/// Worth of a node of `n` Gaussians as an object; 0 if it is none.
fn worth(views: &NodeViews, n: u32, min_gaussians: u32) -> f64 {
    // A view that outlines nothing of the node is no judge.
    let is_judge =
        |view: &&NodeView| !view.masks.is_empty() && u64::from(view.n) * 10 >= u64::from(n) * OBSERVED_TENTHS;
    let judges = views.values().filter(is_judge);
    let (mut sum, mut weights, mut n_whole, mut n_judges) = (0.0, 0.0, 0.0, 0.0);
    for view in judges {
        let uncut = f64::from(view.uncut.max(LEAST_UNCUT));
        let weight = uncut * uncut * (view.weight_px / FULL_PX).min(1.0);
        (sum, weights) = (sum + weight * view.agreement, weights + weight);
        n_judges += 1.0;
        if u64::from(view.n) * 10 >= u64::from(n) * WHOLE_TENTHS && view.agreement > SAME_IOU {
            n_whole += ((f64::from(view.uncut) - NEARLY_WHOLE) / (WHOLE - NEARLY_WHOLE)).clamp(0.0, 1.0);
        }
    }
    let is_whole = n_whole > 0.0 && JUDGES_PER_WHOLE * n_whole >= n_judges;
    if n < min_gaussians || !is_whole || sum < MIN_CONSENSUS * weights {
        return 0.0;
    }
    let consensus = sum / weights;
    let square = consensus * consensus;
    let fourth = square * square;
    // Only operations that give the same bits everywhere.
    fourth * fourth * f64::from(n).sqrt().sqrt()
}

/// Object of each superpoint, or `None`; objects are numbered by their first superpoints.
pub(super) fn objects(tree: &Tree, sightings: &Sightings, sizes: Sizes<'_>) -> Vec<Option<u32>> {
    let worths = worths(tree, sightings, sizes);
    // The best choice within each node: the node, or the best of its parts.
    let mut best = worths.clone();
    for node in tree.n_leaves..tree.len() {
        let of_parts: f64 = tree.parts_of(node).into_iter().flatten().map(|part| best[part]).sum();
        best[node] = best[node].max(of_parts);
    }
    let mut node_of: Vec<Option<usize>> = vec![None; tree.n_leaves];
    let mut waiting: Vec<(usize, Option<usize>)> = tree.roots().map(|root| (root, None)).collect();
    while let Some((node, within)) = waiting.pop() {
        let is_object = worths[node] > 0.0 && worths[node] >= best[node];
        let within = within.or(is_object.then_some(node));
        match tree.parts_of(node) {
            Some(parts) => waiting.extend(parts.map(|part| (part, within))),
            None => node_of[node] = within,
        }
    }
    let mut numbers = BTreeMap::new();
    let mut number = |node: usize| {
        let next = numbers.len() as u32;
        *numbers.entry(node).or_insert(next)
    };
    node_of.into_iter().map(|node| node.map(&mut number)).collect()
}

fn worths(tree: &Tree, sightings: &Sightings, sizes: Sizes<'_>) -> Vec<f64> {
    let Sizes { of_superpoints, min_gaussians, .. } = sizes;
    let is_ground = |footprint: &Footprint| sizes.standing.is_bare_ground(footprint);
    let alone = |superpoint: usize| match sizes.footprints.get(superpoint).is_some_and(is_ground) {
        true => 0.0,
        false => worth(&views_of(sightings, superpoint, sizes), of_superpoints[superpoint], min_gaussians),
    };
    let mut worths: Vec<f64> = (0..tree.n_leaves).into_par_iter().map(alone).collect();
    let (mut n_of, mut footprints) = (of_superpoints.to_vec(), sizes.footprints.to_vec());
    let mut views_of_node: BTreeMap<usize, NodeViews> = BTreeMap::new();
    for node in tree.n_leaves..tree.len() {
        let Some(parts) = tree.parts_of(node) else { continue };
        let mut take = |part: usize| match views_of_node.remove(&part) {
            Some(views) => views,
            None => views_of(sightings, part, sizes),
        };
        let [mut views, mut fewer] = parts.map(&mut take);
        if fewer.len() > views.len() {
            std::mem::swap(&mut views, &mut fewer);
        }
        for (view, other) in fewer {
            let of_view = views.entry(view).or_default();
            of_view.add(other);
            of_view.judge(sizes);
        }
        let n = parts.iter().map(|part| n_of[*part]).sum();
        n_of.push(n);
        let of_parts = parts.map(|part| footprints.get(part).copied());
        let footprint = of_parts.into_iter().flatten().reduce(Footprint::with);
        footprints.extend(footprint);
        let is_ground = footprint.as_ref().is_some_and(is_ground);
        worths.push(if is_ground { 0.0 } else { worth(&views, n, min_gaussians) });
        views_of_node.insert(node, views);
    }
    worths
}

/// Object that each mask shows, or `None`. `object_of`: by superpoint.
pub(super) fn objects_of_masks(
    object_of: &[Option<u32>],
    sightings: &Sightings,
    n_of_mask: &[u32],
) -> Vec<Option<u32>> {
    let n_objects = object_of.iter().flatten().max().map_or(0, |last| *last as usize + 1);
    let mut superpoints: Vec<Vec<usize>> = vec![Vec::new(); n_objects];
    for (superpoint, object) in object_of.iter().enumerate() {
        object.iter().for_each(|object| superpoints[*object as usize].push(superpoint));
    }
    let same = |superpoints: &Vec<usize>| -> Vec<u32> {
        let mut views = NodeViews::new();
        for of_view in
            superpoints.iter().flat_map(|superpoint| sightings.of(*superpoint)).filter(|of| of.n > 0)
        {
            views.entry(of_view.view).or_default().add(NodeView::of(&of_view));
        }
        let masks = views.values().flat_map(|view| view.ious(n_of_mask).filter(|(_, iou)| *iou > SAME_IOU));
        masks.map(|(mask, _)| mask).collect()
    };
    let same: Vec<Vec<u32>> = superpoints.par_iter().map(same).collect();
    let mut object_of_mask = vec![None; n_of_mask.len()];
    for (object, masks) in (0u32..).zip(same) {
        masks.iter().for_each(|mask| object_of_mask[*mask as usize] = Some(object));
    }
    object_of_mask
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: one of 11 views shows the node whole, the others' masks are cut; one of 12 is too few.
    #[test]
    fn one_of_eleven_views_must_show_an_object_whole_and_a_fifth_of_it() {
        let view =
            |uncut| NodeView { n: 10, weight_px: 4096.0, masks: [(0, 10)].into(), agreement: 0.9, uncut };
        let views = |n: u32| (0..n).map(|at| (at, view(if at == 0 { 1.0 } else { 0.5 }))).collect();
        assert!((worth(&views(11), 16, 1) - 0.9_f64.powi(8) * 2.0).abs() < 1e-6);
        assert_eq!(worth(&views(12), 16, 1), 0.0);
        // Cut a little, two count for one.
        let half = |at: &mut NodeView| at.uncut = 0.84;
        let mut nearly: NodeViews = views(11);
        nearly.values_mut().take(2).for_each(half);
        assert!(worth(&nearly, 16, 1) > 0.0);
        nearly.values_mut().next().iter_mut().for_each(|view| view.uncut = 0.5);
        assert_eq!(worth(&nearly, 16, 1), 0.0);
        // It sees a fifth of 50 Gaussians, and less of 51.
        assert!(worth(&views(11), 50, 1) > 0.0 && worth(&views(11), 51, 1) == 0.0);
    }

    /// By hand: a view agrees to 0.9, one a quarter as large to 0.5; the mean is 0.82.
    #[test]
    fn views_from_afar_count_less() {
        let view = |weight_px, agreement| NodeView {
            n: 10,
            weight_px,
            masks: [(0, 10)].into(),
            agreement,
            uncut: 1.0,
        };
        let views = |far_px| NodeViews::from([(0, view(9000.0, 0.9)), (1, view(far_px, 0.5))]);
        assert!((worth(&views(1024.0), 16, 1) - 0.82_f64.powi(8) * 2.0).abs() < 1e-9);
        assert!((worth(&views(4096.0), 16, 1) - 0.7_f64.powi(8) * 2.0).abs() < 1e-9);
    }

    /// By hand: of two masks that agree equally, one of a standing thing counts three quarters.
    #[test]
    fn masks_of_what_stands_count_less() {
        let mut view = NodeView {
            n: 10,
            weight_px: 4096.0,
            masks: [(0, 10), (1, 8)].into(),
            agreement: 0.0,
            uncut: 1.0,
        };
        let mut agreement = |is_standing: &[bool]| {
            let (of_masks, uncut_shares) = (&[10, 8][..], &[1.0, 0.5][..]);
            view.judge(Sizes {
                of_masks,
                uncut_shares,
                is_standing,
                of_superpoints: &[],
                footprints: &[],
                standing: &Standing::default(),
                min_gaussians: 1,
            });
            (view.agreement, view.uncut)
        };
        assert_eq!(agreement(&[false, false]), (1.0, 1.0));
        assert_eq!(agreement(&[true, false]), (0.8, 0.5));
        assert_eq!(agreement(&[true, true]), (0.75, 1.0));
    }
}
