//! Which relations truly hold in a generated scene: by the boxes of its layout, with rules of their own, which
//! share no code with the robot's.

use glam::{DVec2, DVec3};
use serde::Serialize;
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

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Asked {
    On,
    Near,
    Beside,
    LeftOf,
    RightOf,
    InFrontOf,
    Behind,
    Nearest,
    Second,
    Largest,
}

/// Each relation's question about a thing `A` and another `B`.
pub(super) const QUESTIONS: [(Asked, &str); 10] = [
    (Asked::On, "{A} on the {B}"),
    (Asked::Near, "{A} near the {B}"),
    (Asked::Beside, "{A} beside the {B}"),
    (Asked::LeftOf, "{A} left of the {B}"),
    (Asked::RightOf, "{A} right of the {B}"),
    (Asked::InFrontOf, "{A} in front of the {B}"),
    (Asked::Behind, "{A} behind the {B}"),
    (Asked::Nearest, "nearest {A} to the {B}"),
    (Asked::Second, "second {A} from the {B}"),
    (Asked::Largest, "largest {A} near the {B}"),
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

/// Returns the indices of the things that a question means. `robot`: where it is asked.
pub(super) fn meant(things: &[Thing], asked: Asked, thing: &str, of: &str, robot: DVec3) -> Vec<usize> {
    let named =
        |word: &str| -> Vec<usize> { (0..things.len()).filter(|at| things[*at].sounds_like(word)).collect() };
    let (ones, others) = (named(thing), named(of));
    let related = |holds: &dyn Fn(&Thing, &Thing) -> bool| -> Vec<usize> {
        let is_related =
            |at: &usize| others.iter().any(|other| other != at && holds(&things[*at], &things[*other]));
        ones.iter().copied().filter(is_related).collect()
    };
    let by_distance = |n: usize| -> Vec<usize> {
        let Some(from) = others.first() else { return Vec::new() };
        let mut sorted: Vec<usize> = ones.iter().copied().filter(|at| at != from).collect();
        sorted.sort_by(|a, b| gap(&things[*a], &things[*from]).total_cmp(&gap(&things[*b], &things[*from])));
        sorted.get(n).copied().into_iter().collect()
    };
    match asked {
        Asked::On => related(&is_on),
        Asked::Near => related(&|a, b| gap(a, b) <= NEAR_M),
        Asked::Beside => related(&|a, b| gap(a, b) <= BESIDE_M && is_level(a, b)),
        Asked::LeftOf => related(&|a, b| is_seen(a, b, robot, 90.0)),
        Asked::RightOf => related(&|a, b| is_seen(a, b, robot, -90.0)),
        Asked::InFrontOf => related(&|a, b| is_seen(a, b, robot, 180.0)),
        Asked::Behind => related(&|a, b| is_seen(a, b, robot, 0.0)),
        Asked::Nearest => by_distance(0),
        Asked::Second => by_distance(1),
        Asked::Largest => {
            let near = related(&|a, b| gap(a, b) <= NEAR_M);
            near.into_iter()
                .max_by(|a, b| things[*a].volume().total_cmp(&things[*b].volume()))
                .into_iter()
                .collect()
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
        let meant = |asked, one, other| meant(&things, asked, one, other, robot);
        assert_eq!(meant(Asked::On, "mug", "table"), [1]);
        assert_eq!(meant(Asked::On, "chair", "table"), [0usize; 0]);
        assert_eq!(meant(Asked::Near, "chair", "table"), [2]);
        assert_eq!(meant(Asked::Beside, "furniture", "chair"), [0]);
        assert_eq!(meant(Asked::RightOf, "chair", "table"), [2, 3]);
        assert_eq!(meant(Asked::LeftOf, "chair", "table"), [0usize; 0]);
        assert_eq!(meant(Asked::Nearest, "chair", "table"), [2]);
        assert_eq!(meant(Asked::Second, "chair", "table"), [3]);
        assert_eq!(meant(Asked::Largest, "furniture", "mug"), [0]);
    }
}
