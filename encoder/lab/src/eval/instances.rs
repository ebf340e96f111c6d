//! Instance recall: the share of the true things that objects find.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use super::truth::Truth;
use crate::table::percent;
use slag_encoder::objects::NONE;

/// Least overlap, as a share of the object or the thing, that counts as a piece.
const PIECE: f64 = 0.25;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct Recall {
    pub(crate) n: usize,
    /// Things found with an intersection over union of at least 0.25.
    pub(crate) n_at_25: usize,
    /// Things found with at least 0.5.
    pub(crate) n_at_50: usize,
}

impl Recall {
    fn count(&mut self, iou: f64) {
        self.n += 1;
        self.n_at_25 += usize::from(iou >= 0.25);
        self.n_at_50 += usize::from(iou >= 0.5);
    }
}

impl fmt::Display for Recall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} and {} of {}", self.n_at_25, self.n_at_50, self.n)
    }
}

/// Instance recall of objects, over sets of Gaussians.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct InstanceReport {
    pub(crate) n_objects: usize,
    /// Gaussians that belong to one, and all: the others' superpoints abstain.
    pub(crate) n_in_objects: [usize; 2],
    /// Objects that are two things (under-segmentation): two labels, floors and walls included, have a quarter of
    /// it each.
    pub(crate) n_merged_objects: usize,
    /// Things that are two objects (over-segmentation): two objects have a quarter of it each.
    pub(crate) n_split_things: usize,
    /// Recall by any object, whatever its word: the quality of the segmentation alone.
    pub(crate) any: Recall,
    /// Recall by objects that reach the threshold for the thing's word.
    pub(crate) of_words: Recall,
    /// Recall by the word's n best objects, where n is the number of things with that word.
    pub(crate) best_of_words: Recall,
}

impl fmt::Display for InstanceReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { n_objects, n_in_objects, n_merged_objects, n_split_things, any, of_words, best_of_words } =
            self;
        let share = percent(n_in_objects[0] as u64, n_in_objects[1] as u64);
        writeln!(
            f,
            "{n_objects} objects of {share} of all Gaussians; things found at IoU 0.25 and 0.5, by any object: {any}"
        )?;
        writeln!(
            f,
            "  by objects above the threshold for the word: {of_words}; by the word's best objects: {best_of_words}"
        )?;
        writeln!(
            f,
            "  objects that are two things: {n_merged_objects}; things that are two objects: {n_split_things}"
        )
    }
}

/// `object_of`: the object of each Gaussian; `classes`: the ids of each word's things, and its scores by object.
pub(super) fn report<'a>(
    truth: &Truth,
    object_of: &[u32],
    n_objects: usize,
    classes: impl Iterator<Item = (&'a [u16], &'a [f32])>,
    threshold: f32,
) -> InstanceReport {
    let mut n_of_object = vec![0u64; n_objects];
    let mut n_of_thing: BTreeMap<u16, u64> = BTreeMap::new();
    let mut n_of_both: BTreeMap<(u16, u32), u64> = BTreeMap::new();
    for (object, thing) in object_of.iter().zip(&truth.id_of_gaussian) {
        *n_of_thing.entry(*thing).or_default() += 1;
        if *object != NONE {
            n_of_object[*object as usize] += 1;
            *n_of_both.entry((*thing, *object)).or_default() += 1;
        }
    }
    let best_iou = |thing: u16, counts: &dyn Fn(u32) -> bool| {
        let of_thing =
            n_of_both.range((thing, 0)..=(thing, u32::MAX)).filter(|((_, object), _)| counts(*object));
        let iou = |((_, object), both): (&(u16, u32), &u64)| {
            *both as f64 / (n_of_object[*object as usize] + n_of_thing[&thing] - both) as f64
        };
        of_thing.map(iou).fold(0.0, f64::max)
    };
    let mut n_labels_of_object = vec![0usize; n_objects];
    let mut n_objects_of_thing: BTreeMap<u16, usize> = BTreeMap::new();
    for ((label, object), both) in &n_of_both {
        let is_piece = |of: u64| *both as f64 >= PIECE * of as f64;
        n_labels_of_object[*object as usize] += usize::from(is_piece(n_of_object[*object as usize]));
        *n_objects_of_thing.entry(*label).or_default() += usize::from(is_piece(n_of_thing[label]));
    }
    let is_split = |id: &u16| n_objects_of_thing.get(id).is_some_and(|n| *n > 1);
    let n_split_things = truth.things.iter().filter(|thing| is_split(&thing.id)).count();
    let n_merged_objects = n_labels_of_object.iter().filter(|n| **n > 1).count();
    let [mut any, mut of_words, mut best_of_words] = [Recall::default(); 3];
    // Things without Gaussians cannot be found.
    let things = truth.things.iter().map(|thing| thing.id).filter(|id| n_of_thing.contains_key(id));
    things.for_each(|thing| any.count(best_iou(thing, &|_| true)));
    for (ids, scores) in classes {
        let ids: Vec<u16> = ids.iter().copied().filter(|id| n_of_thing.contains_key(id)).collect();
        let mut order: Vec<u32> = (0..n_objects as u32).collect();
        order.sort_by(|a, b| scores[*b as usize].total_cmp(&scores[*a as usize]).then(a.cmp(b)));
        order.truncate(ids.len());
        for thing in ids {
            of_words.count(best_iou(thing, &|object| scores[object as usize] >= threshold));
            best_of_words.count(best_iou(thing, &|object| order.contains(&object)));
        }
    }
    let n_in_objects = [object_of.iter().filter(|object| **object != NONE).count(), object_of.len()];
    InstanceReport { n_objects, n_in_objects, n_merged_objects, n_split_things, any, of_words, best_of_words }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::truth::Thing;

    /// By hand: thing 7 (Gaussians 0..4) is object 0 except for one Gaussian; thing 8 (4..8) is split between
    /// objects 1 and 2; thing 9 has no Gaussians; 8..10 are wall, which object 2 includes.
    #[test]
    fn recall_by_hand() {
        let thing = |id: u16, category: &str| Thing { id, category: category.into(), ..Thing::default() };
        let truth = Truth {
            things: vec![thing(7, "chair"), thing(8, "chair"), thing(9, "table")],
            background: vec![thing(1, "wall")],
            id_of_gaussian: vec![7, 7, 7, 7, 8, 8, 8, 8, 1, 1],
        };
        let object_of = [0, 0, 0, NONE, 1, 2, 2, NONE, 2, 2];
        // IoU: 3/4; 1/4 with object 1, 2/6 with object 2.
        let found = |chair: [f32; 3]| {
            let classes: [(&[u16], &[f32]); 2] = [(&[7, 8], &chair), (&[9], &[0.9; 3])];
            report(&truth, &object_of, 3, classes.into_iter(), 0.5)
        };
        // Object 2 is half thing and half wall; thing 8 is a quarter of object 1 and half of object 2.
        let whole = found([0.0; 3]);
        assert_eq!((whole.n_objects, whole.n_merged_objects, whole.n_split_things), (3, 1, 1));
        assert_eq!(whole.n_in_objects, [8, 10]);
        let recall = |n, n_at_25, n_at_50| Recall { n, n_at_25, n_at_50 };
        let report = found([0.9, 0.6, 0.1]);
        let seen = (report.any, report.of_words, report.best_of_words);
        assert_eq!(seen, (recall(2, 2, 1), recall(2, 2, 1), recall(2, 2, 1)));
        let report = found([0.4, 0.1, 0.8]);
        assert_eq!((report.of_words, report.best_of_words), (recall(2, 1, 0), recall(2, 2, 1)));
        let report = found([0.1, 0.45, 0.48]);
        assert_eq!((report.of_words, report.best_of_words), (recall(2, 0, 0), recall(2, 1, 0)));
    }
}
