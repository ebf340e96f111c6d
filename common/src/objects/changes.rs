//! Which things of two generations are the same.
//!
//! First those of the same Gaussians; then those that look alike and whose boxes overlap, most overlap first; then, of
//! the rest, those that look alike and have the same size, nearest first. A thing is matched once.

use glam::DVec3;
use serde::Serialize;

use super::thing::Thing;
use crate::frames::Aabb;

/// Least cosine of the vectors of a thing that stayed. Other photos change a thing's vector; another thing at its place
/// differs more.
const STAYED_COSINE: f64 = 0.8;
/// Least share of the union of two boxes that both cover, for a thing that stayed.
const STAYED_OVERLAP: f64 = 0.25;
/// Least cosine of the vectors of a thing that moved: more than for one that stayed, as its place says nothing.
const MOVED_COSINE: f64 = 0.9;
/// Largest ratio of the edges of a thing that moved, the longest to the longest and so on: it may have turned.
const MOVED_SIZE_RATIO: f64 = 1.5;
/// Boxes are widened on each side by this share of their diagonal, so that flat things overlap as thick ones do.
const MARGIN: f64 = 0.05;
/// Things of the later list that one of the earlier may be paired with, those of lowest cost: bounds memory where thousands
/// are alike.
const MAX_CANDIDATES: usize = 32;

/// A thing that lies elsewhere.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Moved {
    /// As it was.
    pub from: Thing,
    /// As it is.
    pub to: Thing,
    /// Between the positions, world units.
    pub distance: f64,
}

/// The changes from one list of things to another.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Changes {
    /// Things of exactly the same Gaussians.
    pub n_same: usize,
    /// Things at the same place whose Gaussians changed.
    pub n_stayed: usize,
    /// Things whose place only one of the lists knows.
    pub n_not_compared: usize,
    /// Things of the later list alone, by id.
    pub appeared: Vec<Thing>,
    /// Things of the earlier list alone, by id.
    pub went: Vec<Thing>,
    /// Things that lie elsewhere, by the ids that they had.
    pub moved: Vec<Moved>,
}

/// Returns the changes between two lists, each ascending by id.
///
/// `new_knows` says whether the later list would have a thing of the earlier one if it were still there, `old_knows` the
/// reverse; other things are matched where they lie, and not compared otherwise.
pub fn changes(
    old: Vec<Thing>,
    new: Vec<Thing>,
    new_knows: impl Fn(&Thing) -> bool,
    old_knows: impl Fn(&Thing) -> bool,
) -> Changes {
    let is_in = |things: &[Thing], id: u64| things.binary_search_by_key(&id, |thing| thing.id).is_ok();
    let n_same = new.iter().filter(|thing| is_in(&old, thing.id)).count();
    let went: Vec<Thing> = old.iter().filter(|thing| !is_in(&new, thing.id)).cloned().collect();
    let appeared: Vec<Thing> = new.into_iter().filter(|thing| !is_in(&old, thing.id)).collect();
    let stayed = pairs(&went, &appeared, |old, new| {
        let overlap = overlap(&old.box_in_world, &new.box_in_world);
        (overlap >= STAYED_OVERLAP && cosine(old, new) >= STAYED_COSINE).then_some(-overlap)
    });
    let [mut went, mut appeared] = without(went, appeared, &stayed);
    let n_rest = went.len() + appeared.len();
    went.retain(new_knows);
    appeared.retain(old_knows);
    let n_not_compared = n_rest - went.len() - appeared.len();
    let moved = pairs(&went, &appeared, |old, new| {
        let distance = old.position_in_world.distance(new.position_in_world);
        (have_one_size(old, new) && cosine(old, new) >= MOVED_COSINE).then_some(distance)
    });
    let of_pair = |&(at_old, at_new): &(usize, usize)| {
        let (from, to) = (went[at_old].clone(), appeared[at_new].clone());
        Moved { distance: from.position_in_world.distance(to.position_in_world), from, to }
    };
    let mut list: Vec<Moved> = moved.iter().map(of_pair).collect();
    list.sort_by_key(|moved| moved.from.id);
    let [went, appeared] = without(went, appeared, &moved);
    Changes { n_same, n_stayed: stayed.len(), n_not_compared, appeared, went, moved: list }
}

/// Pairs the things of two lists, lowest cost first; `None` for what cannot be a pair.
fn pairs(old: &[Thing], new: &[Thing], cost: impl Fn(&Thing, &Thing) -> Option<f64>) -> Vec<(usize, usize)> {
    let mut candidates: Vec<(f64, usize, usize)> = Vec::new();
    for (at_old, old) in old.iter().enumerate() {
        let of_old = new.iter().enumerate().filter_map(|(at, new)| Some((cost(old, new)?, at_old, at)));
        let first = candidates.len();
        candidates.extend(of_old);
        if candidates.len() > first + MAX_CANDIDATES {
            candidates[first..].sort_by(|a, b| a.0.total_cmp(&b.0).then(a.2.cmp(&b.2)));
            candidates.truncate(first + MAX_CANDIDATES);
        }
    }
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let (mut old_is_free, mut new_is_free) = (vec![true; old.len()], vec![true; new.len()]);
    candidates.retain(|(_, at_old, at_new)| {
        let is_pair = old_is_free[*at_old] && new_is_free[*at_new];
        if is_pair {
            (old_is_free[*at_old], new_is_free[*at_new]) = (false, false);
        }
        is_pair
    });
    candidates.into_iter().map(|(_, at_old, at_new)| (at_old, at_new)).collect()
}

/// Returns both lists without the things of pairs.
fn without(old: Vec<Thing>, new: Vec<Thing>, pairs: &[(usize, usize)]) -> [Vec<Thing>; 2] {
    let rest = |things: Vec<Thing>, mut taken: Vec<usize>| -> Vec<Thing> {
        taken.sort_unstable();
        let is_free = |at: &usize| taken.binary_search(at).is_err();
        things.into_iter().enumerate().filter(|(at, _)| is_free(at)).map(|(_, thing)| thing).collect()
    };
    let (of_old, of_new) = pairs.iter().copied().unzip();
    [rest(old, of_old), rest(new, of_new)]
}

fn cosine(a: &Thing, b: &Thing) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let lengths = (dot(&a.vector, &a.vector) * dot(&b.vector, &b.vector)).sqrt();
    dot(&a.vector, &b.vector) / lengths.max(f64::MIN_POSITIVE)
}

/// Returns the share of the union of two boxes that both cover, 0 to 1, with margins.
fn overlap(a: &Aabb, b: &Aabb) -> f64 {
    let [a, b] = [a, b].map(|of| {
        let margin = DVec3::splat(MARGIN * of.size().length());
        Aabb { min: of.min - margin, max: of.max + margin }
    });
    let volume = |size: DVec3| size.max(DVec3::ZERO).element_product();
    let both = volume(a.max.min(b.max) - a.min.max(b.min));
    both / (volume(a.size()) + volume(b.size()) - both).max(f64::MIN_POSITIVE)
}

/// Returns whether the edges of two boxes are alike, in whatever directions.
fn have_one_size(a: &Thing, b: &Thing) -> bool {
    let edges = |of: &Thing| {
        let size = of.box_in_world.size();
        // A flat thing's thickness is noise.
        let least = MARGIN * size.length();
        let mut edges = size.to_array().map(|edge| edge.max(least));
        edges.sort_by(f64::total_cmp);
        edges
    };
    edges(a).iter().zip(edges(b)).all(|(a, b)| a.max(b) <= MOVED_SIZE_RATIO * a.min(b))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn thing(id: u64, position: [f64; 3], size: [f64; 3], vector: [f64; 2]) -> Thing {
        let (position_in_world, half) = (DVec3::from(position), DVec3::from(size) * 0.5);
        Thing {
            id,
            n_gaussians: 1,
            position_in_world,
            box_in_world: Aabb { min: position_in_world - half, max: position_in_world + half },
            photo: "a.png".into(),
            vector: vector.to_vec(),
        }
    }

    fn all(old: Vec<Thing>, new: Vec<Thing>) -> Changes {
        changes(old, new, |_| true, |_| true)
    }

    const CHAIR: [f64; 2] = [1.0, 0.0];
    const TABLE: [f64; 2] = [0.0, 1.0];

    /// By hand: one of each kind.
    #[test]
    fn each_change_is_named() {
        let old = vec![
            thing(1, [0.0; 3], [1.0; 3], CHAIR),
            thing(2, [5.0, 0.0, 0.0], [1.0; 3], TABLE),
            thing(3, [10.0, 0.0, 0.0], [1.0, 2.0, 0.5], CHAIR),
            thing(4, [20.0, 0.0, 0.0], [1.0; 3], TABLE),
        ];
        let new = vec![
            thing(1, [0.0; 3], [1.0; 3], CHAIR),
            thing(5, [5.1, 0.0, 0.0], [1.1; 3], TABLE),
            // It turned: length and width have changed places.
            thing(6, [13.0, 4.0, 0.0], [2.0, 1.0, 0.5], CHAIR),
            thing(7, [20.0, 0.0, 0.0], [1.0; 3], CHAIR),
        ];
        let ids = |things: &[Thing]| things.iter().map(|thing| thing.id).collect::<Vec<_>>();
        let found = all(old, new);
        assert_eq!((found.n_same, found.n_stayed), (1, 1));
        assert_eq!(
            (ids(&found.went), ids(&found.appeared)),
            (vec![4], vec![7]),
            "another thing in its place"
        );
        let [moved] = &found.moved[..] else { panic!("{:?}", found.moved) };
        assert_eq!((moved.from.id, moved.to.id, moved.distance), (3, 6, 5.0));
    }

    /// Of two alike things, each goes to the nearer place; one of another size is none of them.
    #[test]
    fn a_thing_is_matched_once_and_to_the_nearest() {
        let at = |id, x: f64, size: f64| thing(id, [x, 0.0, 0.0], [size; 3], CHAIR);
        let found = all(vec![at(1, 0.0, 1.0), at(2, 10.0, 1.0)], vec![at(3, 13.0, 1.0), at(4, 12.0, 3.0)]);
        assert_eq!(found.moved.iter().map(|m| (m.from.id, m.to.id)).collect::<Vec<_>>(), [(2, 3)]);
        assert_eq!((found.went[0].id, found.appeared[0].id), (1, 4));
    }

    /// Boxes of 1 with margins of 0.05 sqrt(3) are 1.17 wide; half a unit apart they share 0.67 of 1.67 (by hand 0.402).
    #[test]
    fn overlaps_by_hand() {
        let of = |x: f64, thickness: f64| thing(1, [x, 0.0, 0.0], [1.0, 1.0, thickness], CHAIR).box_in_world;
        assert!((overlap(&of(0.0, 1.0), &of(0.5, 1.0)) - 0.402).abs() < 2e-3);
        assert!((overlap(&of(0.0, 0.0), &of(0.0, 0.0)) - 1.0).abs() < 1e-12, "a flat thing");
        assert_eq!(overlap(&of(0.0, 1.0), &of(3.0, 1.0)), 0.0);
    }

    /// Both lists end at x = 10, the earlier one at x = 0 as well. By hand: a thing that only one can know is neither new nor
    /// gone, one across the border that changed a little stays, and one does not move to where it may have been all the time.
    #[test]
    fn what_one_list_cannot_know_is_not_compared() {
        let at = |id, x: f64| thing(id, [x, 0.0, 0.0], [1.0; 3], CHAIR);
        let old_knows = |of: &Thing| of.box_in_world.min.x >= 0.0 && of.box_in_world.max.x <= 10.0;
        let new_knows = |of: &Thing| of.box_in_world.max.x <= 10.0;
        let old = vec![at(1, 10.0), at(2, 20.0), at(3, 5.0)];
        let new = vec![at(4, 10.1), at(5, -5.0), at(6, 7.0)];
        let found = changes(old, new, new_knows, old_knows);
        assert_eq!((found.n_same, found.n_stayed, found.n_not_compared), (0, 1, 2));
        assert!(found.went.is_empty() && found.appeared.is_empty(), "{found:?}");
        assert_eq!(found.moved.iter().map(|m| (m.from.id, m.to.id)).collect::<Vec<_>>(), [(3, 6)]);
    }

    /// A hundred alike things that all moved by one: each is matched, though each has more candidates than are kept.
    #[test]
    fn many_alike_things_are_all_matched() {
        let row = |first: u64, shift: f64| -> Vec<Thing> {
            let at = |n: u64| thing(first + n, [10.0 * n as f64 + shift, 0.0, 0.0], [1.0; 3], CHAIR);
            (0..100).map(at).collect()
        };
        let found = all(row(0, 0.0), row(1000, 3.0));
        assert_eq!((found.moved.len(), found.went.len(), found.appeared.len()), (100, 0, 0));
        assert!(found.moved.iter().all(|moved| moved.to.id == moved.from.id + 1000));
        assert!(found.moved.is_sorted_by_key(|moved| moved.from.id));
    }
}
