//! The things of a scene as its labels and its store know them: pixels that show each, and its object on board.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, anyhow};
use slag_common::objects::public_id;
use slag_encoder::objects::NONE;
use slag_encoder::query::PublishedObjects;
use slag_encoder::store::StoreReader;

use crate::eval::truth::Truth;

/// A thing of the labels.
pub(super) struct Label {
    /// Pixels that show it, over all photos.
    pub(super) n_pixels: u64,
    /// Its object, as replies name it.
    pub(super) object: Option<String>,
}

/// Returns the things of a scene and its store, in the order of the layout.
pub(super) fn read(scene: &Path, store: &Path) -> Result<Vec<Label>> {
    let reader = StoreReader::open(store)?;
    let objects = PublishedObjects::read(&reader)?;
    let truth = Truth::read(scene, objects.object_of.len())?;
    let labels: serde_json::Value = serde_json::from_slice(&fs_err::read(scene.join("gt/instances.json"))?)?;
    let list = |name: &str| labels[name].as_array().cloned().unwrap_or_default();
    let object_of_thing = objects_of_things(&truth.id_of_gaussian, &objects.object_of);
    // Shell and things are listed apart, each in the order of the layout; shell nouns are placed first.
    let all = [list("background"), list("instances")].concat();
    let label = |thing: &serde_json::Value| {
        let id = thing["id"]
            .as_u64()
            .and_then(|id| u16::try_from(id).ok())
            .ok_or_else(|| anyhow!("a thing has no id"))?;
        let object = object_of_thing.get(&id).map(|object| public_id(objects.ids[*object as usize]));
        Ok(Label { n_pixels: thing["train_pixels"].as_u64().unwrap_or(0), object })
    };
    all.iter().map(label).collect::<Result<_>>().with_context(|| scene.display().to_string())
}

/// Returns the object of each thing: of those that are the thing by more than half of their Gaussians, the one with most. Boxes are
/// not compared: strays make them as large as the room.
fn objects_of_things(thing_of: &[u16], object_of: &[u32]) -> BTreeMap<u16, u32> {
    let (mut n_of_object, mut n_of_both) = (BTreeMap::new(), BTreeMap::new());
    for (thing, object) in thing_of.iter().zip(object_of).filter(|(_, object)| **object != NONE) {
        *n_of_object.entry(*object).or_insert(0u64) += 1;
        *n_of_both.entry((*object, *thing)).or_insert(0u64) += 1;
    }
    let mut most: BTreeMap<u16, (u64, u32)> = BTreeMap::new();
    for ((object, thing), both) in n_of_both {
        if 2 * both > n_of_object[&object] && most.get(&thing).is_none_or(|(n, _)| both > *n) {
            most.insert(thing, (both, object));
        }
    }
    most.into_iter().map(|(thing, (_, object))| (thing, object)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: object 0 is thing 1 by 3 of 4, object 1 is it by 2 of 2, object 2 is things 2 and 3 by half each.
    #[test]
    fn an_object_is_the_thing_that_it_mostly_is() {
        let found = objects_of_things(&[1, 1, 1, 2, 1, 1, 2, 3, 3], &[0, 0, 0, 0, 1, 1, 2, 2, NONE]);
        assert_eq!(found, BTreeMap::from([(1, 0)]));
    }
}
