//! The demo's questions: about things in the scene, and about one thing that is absent.

use glam::DVec3;

use crate::generate::TrueObject;

/// Only things with at least this many pixels in the photos are asked for.
const MIN_PIXELS: u64 = 12_000;
const ABSENT: &str = "an elephant";

pub(super) struct Asked<'a> {
    pub(super) text: String,
    /// The things it describes; empty if nothing should be found.
    pub(super) truth: Vec<&'a TrueObject>,
}

struct Form {
    /// The question about a thing; `None` where the form does not fit the thing.
    text: fn(&TrueObject) -> Option<String>,
    /// Whether a question about the first thing also describes the second.
    is_true: fn(&TrueObject, &TrueObject) -> bool,
}

const FORMS: [Form; 7] = [
    Form { text: |o| Some(o.category.clone()), is_true: same_noun },
    Form {
        text: |o| Some(format!("{} {}", o.colours.first()?, o.category)),
        is_true: |a, b| same_noun(a, b) && a.colours.first() == b.colours.first(),
    },
    Form {
        text: |o| o.words.iter().find(|word| **word != o.category).map(|word| format!("the {word}")),
        is_true: same_noun,
    },
    Form {
        text: |o| use_of(o).cloned(),
        is_true: |a, b| use_of(a).is_some_and(|kind| b.kinds.contains(kind)),
    },
    Form {
        text: |o| Some(format!("{} {}", adjective(&o.material)?, o.category)),
        is_true: |a, b| same_noun(a, b) && a.material == b.material,
    },
    Form { text: |o| Some(format!("where is the {}", o.category)), is_true: same_noun },
    Form { text: |o| plural(&o.category).map(|noun| format!("find {noun}")), is_true: same_noun },
];

fn same_noun(a: &TrueObject, b: &TrueObject) -> bool {
    a.category == b.category
}

fn use_of(object: &TrueObject) -> Option<&String> {
    object.kinds.iter().find(|kind| kind.starts_with("something to"))
}

fn adjective(material: &str) -> Option<&str> {
    match material {
        "wood" => Some("wooden"),
        "metal" | "plastic" | "leather" => Some(material),
        _ => None,
    }
}

/// Plural of a noun that only takes an s.
fn plural(noun: &str) -> Option<String> {
    (!noun.ends_with(['s', 'x', 'h', 'y', 'f'])).then(|| format!("{noun}s"))
}

/// Returns questions about things within `radius_m` of the robot: one a form, about the thing with the most pixels
/// among those that fit the form and were not asked for yet; then one without an answer.
pub(super) fn questions(objects: &[TrueObject], robot_in_world: DVec3, radius_m: f64) -> Vec<Asked<'_>> {
    let mut left: Vec<&TrueObject> = objects
        .iter()
        .filter(|o| !o.background && o.train_pixels >= MIN_PIXELS)
        .filter(|o| o.centre.distance(robot_in_world) < radius_m)
        .collect();
    left.sort_by_key(|o| (std::cmp::Reverse(o.train_pixels), o.id));
    let mut asked = Vec::new();
    for Form { text, is_true } in FORMS {
        let Some((object, text)) = left.iter().find_map(|o| Some((*o, text(o)?))) else { continue };
        left.retain(|other| !same_noun(object, other));
        asked.push(Asked { text, truth: objects.iter().filter(|other| is_true(object, other)).collect() });
    }
    asked.push(Asked { text: ABSENT.into(), truth: Vec::new() });
    asked
}
