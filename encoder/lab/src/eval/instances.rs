//! Instance recall: the share of the true things that objects find.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;
use slag_encoder::objects::NONE;

use super::truth::Truth;

/// Things, and those found by any object, whatever its word: the quality of the segmentation alone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct Recall {
    pub(crate) n: usize,
    /// With an intersection over union of at least 0.5.
    pub(crate) n_at_50: usize,
}

impl fmt::Display for Recall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {}", self.n_at_50, self.n)
    }
}

/// `object_of`: the object of each Gaussian.
pub(super) fn recall(truth: &Truth, object_of: &[u32]) -> Recall {
    let mut n_of_object: BTreeMap<u32, u64> = BTreeMap::new();
    let mut n_of_thing: BTreeMap<u16, u64> = BTreeMap::new();
    let mut n_of_both: BTreeMap<(u16, u32), u64> = BTreeMap::new();
    for (object, thing) in object_of.iter().zip(&truth.id_of_gaussian) {
        *n_of_thing.entry(*thing).or_default() += 1;
        if *object != NONE {
            *n_of_object.entry(*object).or_default() += 1;
            *n_of_both.entry((*thing, *object)).or_default() += 1;
        }
    }
    let is_found = |thing: &u16| {
        let mut of_thing = n_of_both.range((*thing, 0)..=(*thing, u32::MAX));
        of_thing.any(|((_, object), both)| 2 * both >= n_of_object[object] + n_of_thing[thing] - both)
    };
    // Things without Gaussians cannot be found.
    let things = truth.things.iter().map(|thing| thing.id).filter(|id| n_of_thing.contains_key(id));
    things.fold(Recall::default(), |Recall { n, n_at_50 }, thing| Recall {
        n: n + 1,
        n_at_50: n_at_50 + usize::from(is_found(&thing)),
    })
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
        // IoU: 3/4; 1/4 with object 1, 2/6 with object 2.
        let found = recall(&truth, &[0, 0, 0, NONE, 1, 2, 2, NONE, 2, 2]);
        assert_eq!(found, Recall { n: 2, n_at_50: 1 });
    }
}
