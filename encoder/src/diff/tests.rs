use glam::DVec3;
use slag_common::container::AlignedBytes;
use slag_common::frames::Aabb;
use slag_common::manifest::{Manifest, ShardRecord};
use slag_common::shard::sample::{self, SampleObject, SampleObjects, SampleShard};
use slag_common::shard::{Additions, Profile, ShardHeader, ShardLayout};

use super::*;
use crate::store::tests::manifest;
use crate::store::{Extras, Store, StoreError, StoreReader};

/// A shard of things with a Gaussian each, unit boxes around x = their ids, and vectors along one axis. Another `seed`
/// gives other bytes of the same things.
fn shard(seed: u16, ids: &[u64]) -> Vec<u8> {
    let bounds = Aabb { min: DVec3::ZERO, max: DVec3::splat(66.0) };
    let header = sample::header(0, ids.len(), 1, 2, bounds);
    let shard = SampleShard {
        header: ShardHeader { centroid_step: 0.01, encoder_id: [1; 32], ..header },
        positions: vec![[seed, 2, 3]; ids.len()],
        centroid_starts: vec![0, ids.len() as u32],
        centroids: vec![100, 0],
        radii: vec![0.5],
        embeddings: None,
    };
    let object = |(at, id): (u32, &u64)| {
        let position_in_world = DVec3::X * *id as f64;
        SampleObject {
            id: *id,
            position_in_world,
            bounds: Aabb { min: position_in_world - 0.5, max: position_in_world + 0.5 },
            vectors: vec![1.0, 0.0],
            runs: std::iter::once(at..at + 1).collect(),
            n_gaussians: 1,
            photo: "p".into(),
            photo_box_px: [0, 0, 1, 1],
            thumbnail: Vec::new(),
        }
    };
    let objects = (0..).zip(ids).map(object).collect();
    let objects = SampleObjects { objects, score_mean: 0.0, score_spread: 0.1, score_error_bound: 0.0 };
    objects.add_to(&shard.view(), Additions::default())
}

/// Publishes a generation with a cell for each list of shards, by profile.
fn publish(
    store: &Store,
    generation: u64,
    cells: &[&[(Profile, Vec<u8>)]],
    edit: impl FnOnce(&mut Manifest),
) {
    let mut manifest = manifest(generation, &vec![(Hash32([0; 32]), 0); cells.len()]);
    for (cell, shards) in manifest.cells.iter_mut().zip(cells) {
        let template: ShardRecord = cell.shards[&Profile::Compact].clone();
        cell.shards.clear();
        for (profile, bytes) in *shards {
            let (hash, len_bytes) = store.put_bytes(bytes).expect("room");
            cell.shards.insert(*profile, ShardRecord { hash, len_bytes, ..template.clone() });
        }
    }
    edit(&mut manifest);
    store.publish(&manifest, &Extras::new()).expect("publishes");
}

fn compare(reader: &StoreReader) -> Result<Diff, StoreError> {
    let old = reader.previous().expect("two generations");
    diff(Generation { reader, published: old }, Generation { reader, published: reader.current() })
}

fn ids(things: &[Thing]) -> Vec<u64> {
    things.iter().map(|thing| thing.id).collect()
}

/// Cell 0 stays as it is, cell 1 has other things, cell 2 the same things in another shard and a new profile. By
/// hand: 3 and 20 are the same; 10 is gone, 14 is like it and so it moved by 4; 15 appeared.
#[test]
fn two_generations_of_a_store_by_hand() {
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::create_or_open(dir.path()).expect("opens");
    let (kept, exact) = (shard(1, &[3]), shard(7, &[20]));
    let first = [
        &[(Profile::Compact, kept.clone())][..],
        &[(Profile::Compact, shard(4, &[10]))],
        &[(Profile::Compact, shard(1, &[20]))],
    ];
    publish(&store, 1, &first, |_| {});
    let (changed, same_things) = (shard(1, &[14, 15]), shard(2, &[20]));
    let (n_changed, n_same, n_exact) = (changed.len() as u64, same_things.len() as u64, exact.len() as u64);
    let second = [
        &[(Profile::Compact, kept)][..],
        &[(Profile::Compact, changed)],
        &[(Profile::Compact, same_things), (Profile::Exact, exact)],
    ];
    publish(&store, 2, &second, |_| {});
    let found = compare(&store.reader().expect("published")).expect("compares");
    assert_eq!((found.old_generation, found.new_generation, found.metric), (1, 2, true));
    assert_eq!((found.n_same, found.n_stayed), (2, 0), "{found:?}");
    assert_eq!((ids(&found.appeared), ids(&found.went)), (vec![15], vec![]), "{found:?}");
    let [moved] = &found.moved[..] else { panic!("{:?}", found.moved) };
    assert_eq!((moved.from.id, moved.to.id, moved.distance), (10, 14, 4.0));
    let of_box = [moved.from.box_in_world.min.x, moved.to.box_in_world.min.x, moved.to.box_in_world.max.x];
    assert_eq!(of_box, [9.5, 13.5, 14.5]);
    assert_eq!((found.n_cells, found.n_cells_changed), (3, 2));
    let fetched = BTreeMap::from([("compact".to_owned(), n_changed + n_same), ("exact".to_owned(), n_exact)]);
    assert_eq!(found.fetch_bytes, fetched);
}

/// Of the same splat, another outline is neither an added nor a removed thing.
#[test]
fn where_the_splat_is_the_same_nothing_changed() {
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::create_or_open(dir.path()).expect("opens");
    let wide = |manifest: &mut Manifest| manifest.cells[0].bounds.max = DVec3::splat(66.0);
    publish(&store, 1, &[&[(Profile::Compact, shard(1, &[3, 10]))]], wide);
    publish(&store, 2, &[&[(Profile::Compact, shard(1, &[3, 14]))]], wide);
    let found = compare(&store.reader().expect("published")).expect("compares");
    assert_eq!((found.n_same, found.n_stayed, found.n_not_compared), (1, 0, 2), "{found:?}");
    assert!(found.appeared.is_empty() && found.went.is_empty() && found.moved.is_empty(), "{found:?}");
}

/// The finest shards decide; a cell without any has no things; units count only if both generations have them.
#[test]
fn things_come_from_the_finest_shards() {
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::create_or_open(dir.path()).expect("opens");
    let both = [(Profile::Compact, shard(1, &[3])), (Profile::Exact, shard(1, &[3, 30]))];
    publish(&store, 1, &[&both, &[]], |manifest| manifest.metric = false);
    publish(&store, 2, &[&[(Profile::Compact, shard(1, &[3]))], &[]], |_| {});
    let found = compare(&store.reader().expect("published")).expect("compares");
    assert_eq!((ids(&found.went), found.n_same, found.metric), (vec![30], 1, false));
    assert_eq!((found.n_cells_changed, found.fetch_bytes["compact"]), (0, 0));
}

#[test]
fn what_does_not_compare_is_refused() {
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::create_or_open(dir.path()).expect("opens");
    let cell: &[(Profile, Vec<u8>)] = &[(Profile::Compact, shard(1, &[3]))];
    publish(&store, 1, &[cell], |_| {});
    publish(&store, 2, &[cell], |manifest| {
        (manifest.encoder.id, manifest.encoder.name) = (Hash32([2; 32]), "f".into());
    });
    let refused = compare(&store.reader().expect("published")).expect_err("other vectors").to_string();
    let [old, new] = [("e", [1; 32]), ("f", [2; 32])].map(|(name, id)| format!("{name} ({})", Hash32(id)));
    let holds = refused.starts_with(&format!("the generations are of different encoders, {old} and {new};"));
    assert!(holds, "{refused}");

    publish(&store, 3, &[&[(Profile::Compact, without_objects())]], |_| {});
    publish(&store, 4, &[cell], |_| {});
    let refused = compare(&store.reader().expect("published")).expect_err("no objects");
    assert!(refused.to_string().starts_with("generation 3 has no objects"), "{refused}");
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::create_or_open(dir.path()).expect("opens");
    publish(&store, 1, &[cell], |_| {});
    publish(&store, 2, &[cell, &[(Profile::Compact, b"no shard".to_vec())]], |_| {});
    let refused = compare(&store.reader().expect("published")).expect_err("damaged");
    assert!(matches!(refused, StoreError::Shard { .. }), "{refused}");
}

fn without_objects() -> Vec<u8> {
    let bytes = AlignedBytes::copy_of(&shard(1, &[3]));
    let mut bare = Vec::new();
    ShardLayout::check(&bytes).expect("valid").view(&bytes).write(&mut bare).expect("writes to memory");
    bare
}
