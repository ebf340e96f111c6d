//! Plans a fetch: which cells are needed, and which shards to download, keep and free. Pure functions.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use slag_common::Hash32;
use slag_common::manifest::{CellIndex, Manifest, ObjectRecord, TextModelRecord};
use slag_common::shard::Profile;

use super::position::PlanError;
use super::request::Tally;
use crate::store::CurrentCell;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Held {
    pub len_bytes: u64,
    /// Number of the last fetch that needed it.
    pub last_used: u64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wanted {
    pub profile: Profile,
    pub centre_in_world: DVec3,
    /// Cells within this distance are needed, world units.
    pub radius: f64,
    /// Byte budget for shards and text models; absent: twice the length of the needed ones.
    pub max_bytes: Option<u64>,
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Plan {
    pub cells: Vec<CurrentCell>,
    pub download: Vec<ObjectRecord>,
    pub keep: BTreeSet<Hash32>,
    /// Unneeded objects on board within the budget, most recently used first.
    pub spare: BTreeSet<Hash32>,
    pub free: BTreeSet<Hash32>,
}

impl Plan {
    pub fn new(
        manifest: &Manifest,
        wanted: &Wanted,
        held: &BTreeMap<Hash32, Held>,
    ) -> Result<Self, PlanError> {
        let Wanted { profile, centre_in_world, radius, max_bytes } = *wanted;
        if !(radius >= 0.0 && radius.is_finite()) {
            return Err(PlanError::number("radius", radius, "zero or more, and finite"));
        }
        let positions = CellIndex::new(&manifest.cells).within(centre_in_world, radius);
        if positions.is_empty() {
            let distances = manifest.cells.iter().map(|cell| cell.bounds.distance_to(centre_in_world));
            let nearest = distances.fold(f64::INFINITY, f64::min);
            return Err(PlanError(format!(
                "scene {:?} has no cell within {radius} of {centre_in_world}, the nearest is {nearest:.1} away; check the position or increase the radius",
                manifest.scene
            )));
        }
        let cells = cells_at(manifest, profile, &positions)?;
        let needs = objects(&cells, manifest)?;
        let needed: BTreeSet<Hash32> = needs.iter().map(|object| object.hash).collect();
        let needed_bytes = needs.iter().fold(0u64, |sum, object| sum.saturating_add(object.len_bytes));
        let budget_bytes = max_bytes.unwrap_or(needed_bytes.saturating_mul(2));
        if needed_bytes > budget_bytes {
            return Err(PlanError(format!(
                "the {} cells need {needed_bytes} bytes, the limit is {budget_bytes}; choose a smaller radius or profile, or raise the limit",
                cells.len()
            )));
        }
        let mut plan = Self { cells, ..Self::default() };
        for object in needs {
            match held.get(&object.hash) {
                Some(held) if held.len_bytes == object.len_bytes => drop(plan.keep.insert(object.hash)),
                _ => plan.download.push(object),
            }
        }
        let mut others: Vec<(&Hash32, &Held)> =
            held.iter().filter(|(hash, _)| !needed.contains(hash)).collect();
        others.sort_by_key(|(hash, held)| (std::cmp::Reverse(held.last_used), **hash));
        let mut left_bytes = Some(budget_bytes - needed_bytes);
        for (hash, held) in others {
            // The first that does not fit ends this: everything less recent is freed too.
            left_bytes = left_bytes.and_then(|left| left.checked_sub(held.len_bytes));
            match left_bytes {
                Some(_) => plan.spare.insert(*hash),
                None => plan.free.insert(*hash),
            };
        }
        Ok(plan)
    }

    pub(super) fn to_download(&self) -> Tally {
        Tally::of(self.download.iter().map(|object| object.len_bytes))
    }
}

fn cells_at(
    manifest: &Manifest,
    profile: Profile,
    positions: &[usize],
) -> Result<Vec<CurrentCell>, PlanError> {
    let listed = positions.iter().map(|position| {
        let cell = &manifest.cells[*position];
        match cell.shards.get(&profile) {
            Some(shard) => {
                Ok(CurrentCell { cell_id: cell.cell_id, hash: shard.hash, len_bytes: shard.len_bytes })
            }
            None => {
                let names: Vec<&str> = cell.shards.keys().map(|profile| profile.name()).collect();
                let (cell_id, available) = (cell.cell_id, names.join(", "));
                Err(PlanError(format!(
                    "cell {cell_id} has no {profile} shard; it has: {available}; fetch one of those profiles"
                )))
            }
        }
    });
    listed.collect()
}

/// Returns the objects needed before these cells become current: their shards, and the scene's text model.
fn objects(cells: &[CurrentCell], manifest: &Manifest) -> Result<Vec<ObjectRecord>, PlanError> {
    let mut seen = BTreeSet::new();
    let object = |cell: &CurrentCell| match seen.insert(cell.hash) {
        true => Ok(ObjectRecord { hash: cell.hash, len_bytes: cell.len_bytes }),
        false => Err(PlanError(format!(
            "the manifest lists shard {} for cell {} and for another cell; have the scene published again",
            cell.hash, cell.cell_id
        ))),
    };
    let mut objects: Vec<ObjectRecord> = cells.iter().map(object).collect::<Result<_, _>>()?;
    let text_model = manifest.encoder.text_model.iter().flat_map(TextModelRecord::objects);
    objects.extend(text_model.filter(|object| seen.insert(object.hash)));
    Ok(objects)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use slag_common::frames::{Aabb, GeoReference, Geographic};
    use slag_common::shard::sample;
    use slag_test_support::assert_error;

    use super::super::position::Position;
    use super::*;

    fn manifest(boxes: &[(DVec3, DVec3, u64)]) -> Manifest {
        let cell = |(number, (min, size, len_bytes)): (u32, &(DVec3, DVec3, u64))| {
            (Aabb { min: *min, max: *min + *size }, hash(number), *len_bytes)
        };
        let cells: Vec<_> = (0u32..).zip(boxes).map(cell).collect();
        let origin = Geographic { latitude_deg: 46.8, longitude_deg: -91.9, height_m: 150.0 };
        let mut manifest =
            Manifest { geo_reference: Some(GeoReference { origin }), ..sample::manifest_of("s", &cells) };
        manifest.cells.iter_mut().for_each(|cell| cell.cell_id *= 3);
        manifest
    }

    fn hash(number: u32) -> Hash32 {
        Hash32::of(&number.to_le_bytes())
    }

    fn wanted(centre_in_world: DVec3, radius: f64, max_bytes: Option<u64>) -> Wanted {
        Wanted { profile: Profile::Compact, centre_in_world, radius, max_bytes }
    }

    proptest! {
        /// Oracles: distances by brute force; eviction one at a time, least recent first.
        #[test]
        fn plan_equals_brute_force(
            boxes in prop::collection::vec(
                (prop::array::uniform3(-50.0..50.0f64), prop::array::uniform3(0.0..20.0f64), 1..100u64), 1..40),
            held in prop::collection::btree_map(0..60u32, (1..100u64, 0..5u64, any::<bool>()), 0..40),
            centre in prop::array::uniform3(-60.0..60.0f64), radius in 0.0..60.0f64,
            max_bytes in prop::option::of(0..4000u64),
        ) {
            let boxes: Vec<_> = boxes.into_iter().map(|(min, size, len)| (min.into(), size.into(), len)).collect();
            let manifest = manifest(&boxes);
            let centre = DVec3::from(centre);
            // Some held shards have the manifest's length, others are damaged.
            let held: BTreeMap<Hash32, Held> = held.into_iter().map(|(number, (len, last_used, is_sound))| {
                let listed = boxes.get(number as usize).map(|(_, _, len)| *len).filter(|_| is_sound);
                (hash(number), Held { len_bytes: listed.unwrap_or(len), last_used })
            }).collect();
            let plan = Plan::new(&manifest, &wanted(centre, radius, max_bytes), &held);

            let near: Vec<u32> = (0..boxes.len() as u32).filter(|i| {
                let (min, size, _) = boxes[*i as usize];
                centre.clamp(min, min + size).distance(centre) <= radius
            }).collect();
            let needed_bytes: u64 = near.iter().map(|i| boxes[*i as usize].2).sum();
            let budget_bytes = max_bytes.unwrap_or(2 * needed_bytes);
            if near.is_empty() {
                prop_assert!(plan.is_err_and(|e| e.to_string().contains("has no cell within")));
                return Ok(());
            }
            if needed_bytes > budget_bytes {
                prop_assert!(plan.is_err_and(|e| e.to_string().contains("bytes, the limit is")));
                return Ok(());
            }
            let plan = plan.expect("possible");
            let ids: Vec<u32> = plan.cells.iter().map(|cell| cell.cell_id / 3).collect();
            prop_assert_eq!(&ids, &near);
            for i in near {
                let is_held = held.get(&hash(i)).is_some_and(|held| held.len_bytes == boxes[i as usize].2);
                prop_assert_eq!(plan.keep.contains(&hash(i)), is_held);
                prop_assert_eq!(plan.download.iter().any(|cell| cell.hash == hash(i)), !is_held);
            }
            let mut others: Vec<(u64, std::cmp::Reverse<Hash32>, u64)> = held.iter()
                .filter(|(hash, _)| plan.cells.iter().all(|cell| cell.hash != **hash))
                .map(|(hash, held)| (held.last_used, std::cmp::Reverse(*hash), held.len_bytes)).collect();
            let n_others = others.len();
            while needed_bytes + others.iter().map(|(_, _, len)| len).sum::<u64>() > budget_bytes {
                let oldest = *others.iter().min().expect("some are left");
                others.retain(|other| *other != oldest);
            }
            let spare: BTreeSet<Hash32> = others.iter().map(|(_, hash, _)| hash.0).collect();
            prop_assert_eq!(plan.free.len(), n_others - spare.len());
            prop_assert!(plan.free.is_disjoint(&spare));
            prop_assert_eq!(plan.spare, spare);
        }

        /// Oracle: the original horizontal position, and brute force over columns.
        #[test]
        fn latitude_and_longitude_give_the_same_cells(x in 0.0..200.0f64, y in 0.0..10.0f64, z in -5.0..5.0f64) {
            let boxes: Vec<_> = (0..20).map(|i| {
                let i = f64::from(i);
                (DVec3::new(i * 10.0, 0.0, i * 7.0 - 100.0), DVec3::splat(10.0), 1)
            }).collect();
            let manifest = manifest(&boxes);
            let column = (x / 10.0).floor();
            let point = DVec3::new(x, y, column * 7.0 - 95.0 + z);
            let geo = manifest.geo_reference.expect("given").geographic_from_world(point);
            let at = |height_m| Position::Geographic {
                latitude_deg: geo.latitude_deg, longitude_deg: geo.longitude_deg, height_m,
            };
            let with_height = at(Some(geo.height_m)).in_world(&manifest).expect("a place");
            prop_assert!(with_height.distance(point) < 1e-6);
            let without = at(None).in_world(&manifest).expect("a place");
            prop_assert!((without - point).truncate().length() < 0.02, "{} {}", without, point);
            // Near a border either neighbour may be the nearest.
            if (0.1..9.9).contains(&(x - column * 10.0)) {
                prop_assert_eq!(without.z, column * 7.0 - 95.0);
            }
        }
    }

    #[test]
    fn what_cannot_be_is_refused() {
        let good = manifest(&[(DVec3::ZERO, DVec3::ONE, 5), (DVec3::ONE, DVec3::ONE, u64::MAX)]);
        let at_zero =
            |radius, max_bytes| Plan::new(&good, &wanted(DVec3::ZERO, radius, max_bytes), &BTreeMap::new());
        for radius in [-1.0, f64::NAN, f64::INFINITY] {
            let error = at_zero(radius, None).expect_err("no radius").to_string();
            assert!(error.starts_with("radius is "), "{error}");
        }
        assert!(at_zero(0.5, Some(5)).is_ok());
        // 5 + u64::MAX does not wrap around.
        let error = at_zero(9.0, Some(1000)).expect_err("too large");
        let expected = format!("the 2 cells need {} bytes, the limit is 1000;", u64::MAX);
        assert!(error.to_string().starts_with(&expected), "{error}");
        let exact = Wanted { profile: Profile::Exact, ..wanted(DVec3::ZERO, 1.0, None) };
        let error = Plan::new(&good, &exact, &BTreeMap::new()).expect_err("no exact shards");
        assert!(error.to_string().contains("it has: compact"), "{error}");
        let mut twice = good.clone();
        twice.cells[1].shards = twice.cells[0].shards.clone();
        let error =
            Plan::new(&twice, &wanted(DVec3::ZERO, 9.0, None), &BTreeMap::new()).expect_err("conflict");
        assert!(error.to_string().contains(&format!("{} for cell 3 and", hash(0))), "{error}");

        let at = |latitude_deg, longitude_deg| Position::Geographic {
            latitude_deg,
            longitude_deg,
            height_m: None,
        };
        for place in [at(90.1, 0.0), at(f64::NAN, 0.0), at(0.0, -180.5), Position::World(DVec3::NAN)] {
            assert_error(place.in_world(&good), &[", expected within "]);
        }
        let nowhere = Manifest { geo_reference: None, ..good };
        assert_error(at(46.8, -91.9).in_world(&nowhere), &["has no geo-reference"]);
    }
}
