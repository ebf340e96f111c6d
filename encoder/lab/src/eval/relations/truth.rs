//! Which relations truly hold in a generated scene: by the boxes of its layout, with rules of their own, which
//! share no code with the robot's.

use glam::{DVec2, DVec3};
use slag_common::frames::Aabb;

use crate::eval::truth::Thing;

/// Distance of two boxes at which their things are near each other, metres.
const NEAR_M: f64 = 1.0;
/// The same for "beside".
const BESIDE_M: f64 = 0.8;
/// Distance up to which directions are asked about.
const SEEN_M: f64 = 5.0;
/// Largest angle from a direction, degrees; the four directions do not overlap.
const SEEN_DEG: f64 = 45.0;
/// Largest gap between a thing and the top it stands on.
const TOUCHES_M: f64 = 0.05;
/// Least height above the ground of a thing that stands on another.
const RAISED_M: f64 = 0.1;

/// Which of the things that are named a question means.
enum Rule {
    /// Those in a relation to the other thing, as seen by the robot.
    Related(fn(&Thing, &Thing, DVec3) -> bool),
    /// The one of this place by distance from the other thing, counted from 0.
    ByDistance(usize),
    /// The largest of those near the other thing.
    Largest,
}

pub(super) struct Relation {
    /// A question about a `THING` in this relation to an `OTHER` one.
    pub(super) text: &'static str,
    rule: Rule,
}

pub(super) const RELATIONS: [Relation; 10] = [
    Relation { text: "THING on the OTHER", rule: Rule::Related(|a, b, _| is_on(a, b)) },
    Relation { text: "THING near the OTHER", rule: Rule::Related(|a, b, _| gap(a, b) <= NEAR_M) },
    Relation {
        text: "THING beside the OTHER",
        rule: Rule::Related(|a, b, _| gap(a, b) <= BESIDE_M && is_level(a, b)),
    },
    Relation { text: "THING left of the OTHER", rule: Rule::Related(|a, b, at| is_seen(a, b, at, 90.0)) },
    Relation { text: "THING right of the OTHER", rule: Rule::Related(|a, b, at| is_seen(a, b, at, -90.0)) },
    Relation {
        text: "THING in front of the OTHER",
        rule: Rule::Related(|a, b, at| is_seen(a, b, at, 180.0)),
    },
    Relation { text: "THING behind the OTHER", rule: Rule::Related(|a, b, at| is_seen(a, b, at, 0.0)) },
    Relation { text: "nearest THING to the OTHER", rule: Rule::ByDistance(0) },
    Relation { text: "second THING from the OTHER", rule: Rule::ByDistance(1) },
    Relation { text: "largest THING near the OTHER", rule: Rule::Largest },
];

impl Thing {
    pub(super) fn bounds(&self) -> Aabb {
        Aabb { min: self.aabb_min, max: self.aabb_max }
    }

    pub(super) fn is_called(&self, word: &str) -> bool {
        self.category == word || self.kinds.iter().any(|kind| kind == word)
    }

    /// Returns whether a word may name it: "chair" names an armchair to some.
    pub(super) fn sounds_like(&self, word: &str) -> bool {
        self.is_called(word) || self.category.contains(word)
    }

    fn centre(&self) -> DVec3 {
        self.bounds().centre()
    }

    fn volume(&self) -> f64 {
        self.bounds().size().element_product()
    }
}

impl Relation {
    pub(super) fn question(&self, thing: &str, of: &str) -> String {
        self.text.replace("THING", thing).replace("OTHER", of)
    }

    /// Returns the indices of the things that the question means. `robot`: where it is asked.
    pub(super) fn meant(&self, things: &[Thing], thing: &str, of: &str, robot: DVec3) -> Vec<usize> {
        let named = |word: &str| -> Vec<usize> {
            (0..things.len()).filter(|at| things[*at].sounds_like(word)).collect()
        };
        let (ones, others) = (named(thing), named(of));
        let related = |holds: &dyn Fn(&Thing, &Thing) -> bool| -> Vec<usize> {
            let is_related =
                |at: &usize| others.iter().any(|other| other != at && holds(&things[*at], &things[*other]));
            ones.iter().copied().filter(is_related).collect()
        };
        match &self.rule {
            Rule::Related(holds) => related(&|a, b| holds(a, b, robot)),
            Rule::ByDistance(place) => {
                let Some(from) = others.first() else { return Vec::new() };
                let mut sorted: Vec<usize> = ones.iter().copied().filter(|at| at != from).collect();
                let distance = |at: &usize| gap(&things[*at], &things[*from]);
                sorted.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
                sorted.get(*place).copied().into_iter().collect()
            }
            Rule::Largest => {
                let near = related(&|a, b| gap(a, b) <= NEAR_M).into_iter();
                let volume = |at: &usize| things[*at].volume();
                near.max_by(|a, b| volume(a).total_cmp(&volume(b))).into_iter().collect()
            }
        }
    }
}

fn is_on(thing: &Thing, below: &Thing) -> bool {
    let centre = thing.centre().truncate();
    let over = centre.cmpge(below.aabb_min.truncate()).all() && centre.cmple(below.aabb_max.truncate()).all();
    let bottom = thing.aabb_min.z;
    over && bottom > RAISED_M && bottom > below.centre().z - RAISED_M && bottom < below.aabb_max.z + TOUCHES_M
}

fn gap(a: &Thing, b: &Thing) -> f64 {
    (a.aabb_min - b.aabb_max).max(b.aabb_min - a.aabb_max).max(DVec3::ZERO).length()
}

fn is_level(a: &Thing, b: &Thing) -> bool {
    let shared = a.aabb_max.z.min(b.aabb_max.z) - a.aabb_min.z.max(b.aabb_min.z);
    let lower = (a.aabb_max.z - a.aabb_min.z).min(b.aabb_max.z - b.aabb_min.z);
    shared >= 0.3 * lower
}

/// Returns whether a thing is seen in a direction from another: degrees to the left of the line from robot to `of`.
fn is_seen(thing: &Thing, of: &Thing, robot: DVec3, direction_deg: f64) -> bool {
    let sight = (of.centre() - robot).truncate();
    let offset = (thing.centre() - of.centre()).truncate();
    let meant = DVec2::from_angle(direction_deg.to_radians()).rotate(sight);
    gap(thing, of) <= SEEN_M && offset.angle_to(meant).abs().to_degrees() <= SEEN_DEG
}

#[cfg(test)]
mod tests {
    use super::*;

    fn thing(category: &str, min: [f64; 3], max: [f64; 3]) -> Thing {
        let kinds = vec!["furniture".into()];
        let (aabb_min, aabb_max) = (min.into(), max.into());
        Thing { category: category.into(), kinds, aabb_min, aabb_max, ..Thing::default() }
    }

    #[test]
    fn a_room_by_hand() {
        let things = [
            thing("table", [0.0, 0.0, 0.0], [1.6, 0.9, 0.75]),
            thing("mug", [0.5, 0.4, 0.75], [0.6, 0.5, 0.9]),
            thing("chair", [2.0, 0.0, 0.0], [2.5, 0.5, 0.9]),
            thing("chair", [6.0, 0.0, 0.0], [6.5, 0.5, 0.9]),
        ];
        // From the south, looking north.
        let robot = DVec3::new(0.8, -3.0, 0.0);
        let meant = |text: &str, one, other| {
            let relation = RELATIONS.iter().find(|relation| relation.text == text).expect("a relation");
            relation.meant(&things, one, other, robot)
        };
        assert_eq!(meant("THING on the OTHER", "mug", "table"), [1]);
        assert_eq!(meant("THING on the OTHER", "chair", "table"), [0usize; 0]);
        assert_eq!(meant("THING near the OTHER", "chair", "table"), [2]);
        assert_eq!(meant("THING beside the OTHER", "furniture", "chair"), [0]);
        assert_eq!(meant("THING right of the OTHER", "chair", "table"), [2, 3]);
        assert_eq!(meant("THING left of the OTHER", "chair", "table"), [0usize; 0]);
        assert_eq!(meant("nearest THING to the OTHER", "chair", "table"), [2]);
        assert_eq!(meant("second THING from the OTHER", "chair", "table"), [3]);
        assert_eq!(meant("largest THING near the OTHER", "furniture", "mug"), [0]);
    }
}
