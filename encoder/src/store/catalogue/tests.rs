use super::*;
use crate::store::tests::{manifest, new_store};
use crate::store::{Extras, Store, StoreReader};

fn files_of(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs_err::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() { files_of(&path, found) } else { found.push(path) }
    }
}

/// Every file of the database overwritten, cut or removed: the store opens, knows its cells, counts on from its
/// manifest, and meanwhile readers are told the truth.
#[test]
fn a_damaged_catalogue_is_made_anew_from_the_files() {
    let damages: [fn(&Path); 4] = [
        |path| fs_err::write(path, vec![0xA5; 4096]).expect("writes"),
        |path| fs_err::write(path, b"").expect("writes"),
        |path| fs_err::remove_file(path).expect("there"),
        |path| {
            let mut bytes = fs_err::read(path).expect("there");
            bytes.iter_mut().step_by(97).for_each(|byte| *byte ^= 0x41);
            fs_err::write(path, bytes).expect("writes");
        },
    ];
    for (number, damage) in damages.iter().enumerate() {
        let [dir, scratch] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
        let store = Store::create_or_open(dir.path()).expect("opens");
        let shards: Vec<_> = ["a", "b"].map(|text| store.put_bytes(text.as_bytes()).expect("room")).into();
        store.publish(&manifest(6, &shards[..1]), &Extras::new()).expect("publishes");
        store.publish(&manifest(7, &shards), &Extras::new()).expect("publishes");
        drop(store);
        let mut files = Vec::new();
        files_of(&dir.path().join("db"), &mut files);
        files.iter().for_each(|path| damage(path));
        // Readers never trust a damaged catalogue.
        let seen = CatalogueCopy::of(dir.path(), scratch.path()).expect("copies");
        let generations = seen.map(|copy| copy.catalogue.generations().expect("reads")).unwrap_or_default();
        assert!(generations.iter().all(|record| record.n_cells <= 2), "damage {number}");
        let store = Store::create_or_open(dir.path()).unwrap_or_else(|e| panic!("damage {number}: {e}"));
        assert_eq!(store.next_generation().expect("reads"), 8, "damage {number}");
        let generations = store.catalogue().generations().expect("reads");
        let numbers: Vec<u64> = generations.iter().map(|record| record.generation).collect();
        assert_eq!(numbers, [6, 7], "damage {number}");
        store.publish(&manifest(8, &shards), &Extras::new()).expect("publishes");
        assert!(StoreReader::open(dir.path()).expect("whole").verify(|| {}).bad.is_empty());
    }
}

#[test]
fn the_catalogue_keeps_the_history() {
    let (dir, store) = new_store();
    let shards: Vec<_> = ["a", "b", "c"].map(|text| store.put_bytes(text.as_bytes()).expect("room")).into();
    for generation in 1..=3 {
        let manifest = manifest(generation, &shards[..generation as usize]);
        store.publish(&manifest, &Extras::new()).expect("publishes");
    }
    store.prune().expect("prunes");
    drop(store);
    let store = Store::create_or_open(dir.path()).expect("opens");
    let generations = store.catalogue().generations().expect("reads");
    let seen: Vec<(u64, usize)> =
        generations.iter().map(|record| (record.generation, record.n_cells)).collect();
    assert_eq!(seen, [(1, 1), (2, 2), (3, 3)]);
}

fn snapshot_of(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    files_of(folder, &mut files);
    files.sort();
    files.into_iter().map(|path| (path.clone(), fs_err::read(path).expect("readable"))).collect()
}

/// Reading the history changes no file while a writer holds the store.
#[test]
fn a_copy_is_read_while_a_writer_is_at_work() {
    let [dir, scratch] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
    assert!(CatalogueCopy::of(dir.path(), scratch.path()).expect("no store").is_none());
    let store = Store::create_or_open(dir.path()).expect("opens");
    let shard = store.put_bytes(b"a").expect("room");
    store.publish(&manifest(1, &[shard]), &Extras::new()).expect("publishes");
    fs_err::write(dir.path().join("tmp/7.part"), "of the writer").expect("writes");
    let before = snapshot_of(dir.path());
    let copy = CatalogueCopy::of(dir.path(), scratch.path()).expect("copies").expect("there");
    let generations = copy.catalogue.generations().expect("reads");
    assert_eq!(generations.iter().map(|record| record.generation).collect::<Vec<_>>(), [1]);
    assert!(snapshot_of(dir.path()) == before, "the store was written to");
    drop(copy);
    assert_eq!(fs_err::read_dir(scratch.path()).expect("there").count(), 0);
    drop(store);
}
