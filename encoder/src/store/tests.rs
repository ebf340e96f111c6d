use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::Path;

use glam::DVec3;
use slag_common::Hash32;
use slag_common::frames::Aabb;
use slag_common::manifest::{CellRecord, EncoderRecord, Manifest, ShardRecord, VERSION};
use slag_common::shard::Profile;
use slag_test_support::assert_error;

use super::metadata::Metadata;
use super::*;

/// Ways to damage a file: lost, empty, cut, changed near its beginning.
pub(crate) const DAMAGES: [fn(&Path); 4] = [
    |path| fs_err::remove_file(path).expect("there"),
    |path| fs_err::write(path, b"").expect("writable"),
    |path| {
        let bytes = fs_err::read(path).expect("there");
        fs_err::write(path, &bytes[..bytes.len() / 2]).expect("writable");
    },
    |path| {
        let mut bytes = fs_err::read(path).expect("there");
        bytes[20] ^= 1;
        fs_err::write(path, bytes).expect("writable");
    },
];

pub(crate) fn new_store() -> (tempfile::TempDir, Store) {
    let dir = tempfile::tempdir().expect("a folder");
    let store = Store::create_or_open(dir.path()).expect("opens");
    (dir, store)
}

pub(crate) fn manifest_of_boxes(boxes: &[Aabb]) -> Manifest {
    let cell = |(cell_id, bounds): (usize, &Aabb)| CellRecord {
        cell_id: cell_id as u32,
        bounds: *bounds,
        n_gaussians: 1 + cell_id as u32,
        shards: BTreeMap::new(),
    };
    Manifest {
        version: VERSION,
        scene: "yard".into(),
        generation: 1,
        created_unix_secs: 1,
        metric: true,
        geo_reference: None,
        encoder: EncoderRecord {
            name: "e".into(),
            id: Hash32([1; 32]),
            dim: 4,
            default_threshold: 0.5,
            calibration: None,
            text_model: None,
        },
        n_gaussians: boxes.len() as u64,
        n_without_evidence: 0,
        n_rejected: 0,
        cells: boxes.iter().enumerate().map(cell).collect(),
    }
}

/// A manifest with one cell per object, in a row along x.
pub(crate) fn manifest(generation: u64, objects: &[(Hash32, u64)]) -> Manifest {
    let unit_box = |i: usize| {
        let min = DVec3::X * (10 * i) as f64;
        Aabb { min, max: min + DVec3::ONE }
    };
    let boxes: Vec<Aabb> = (0..objects.len()).map(unit_box).collect();
    let mut manifest = Manifest { generation, ..manifest_of_boxes(&boxes) };
    for (cell, &(hash, len_bytes)) in manifest.cells.iter_mut().zip(objects) {
        let record = ShardRecord {
            hash,
            len_bytes,
            n_centroids: 1,
            score_error_bound: 0.0,
            score_errors: Default::default(),
            position_error: 0.0,
        };
        cell.shards.insert(Profile::Compact, record);
    }
    manifest
}

fn put_many(store: &Store, texts: &[impl AsRef<[u8]>]) -> Vec<(Hash32, u64)> {
    texts.iter().map(|text| store.put_bytes(text.as_ref()).expect("room")).collect()
}

fn object_names(store: &Store) -> BTreeSet<String> {
    let folders = fs_err::read_dir(store.dir().join("objects")).expect("folder");
    let files = folders.flat_map(|folder| fs_err::read_dir(folder.expect("entry").path()).expect("folder"));
    files.map(|file| file.expect("entry").file_name().to_string_lossy().into_owned()).collect()
}

#[test]
fn published_scene_is_read_back_verified() {
    let (dir, store) = new_store();
    assert!(matches!(StoreReader::open(dir.path()), Err(StoreError::NotPublished { .. })));
    assert_eq!(store.next_generation().expect("records"), 1);
    let shards = put_many(&store, &["a", "bb"]);
    let field = store.put_bytes(b"field").expect("room").0;
    let extras = Extras::from([("field".to_owned(), field)]);
    let hash = store.publish(&manifest(1, &shards), &extras).expect("publishes");

    let reader = StoreReader::open(dir.path()).expect("published");
    assert_eq!(*reader.manifest(), manifest(1, &shards));
    assert_eq!((reader.current().hash, &reader.current().extras), (hash, &extras));
    assert_eq!(Hash32::of(&fs_err::read(dir.path().join("manifest")).expect("there")), hash);

    assert_eq!(&*reader.read_object(shards[1].0).expect("intact"), b"bb");
    fs_err::write(reader.object_path(shards[1].0), b"bx").expect("writable");
    assert!(matches!(reader.read_object(shards[1].0), Err(StoreError::ObjectHash { .. })));

    assert!(reader.is_current());
    store.publish(&manifest(2, &shards[..1]), &Extras::new()).expect("publishes");
    assert!(!reader.is_current());
    assert_eq!(store.reader().expect("published").previous().map(|p| p.hash), Some(hash));
}

#[test]
fn second_writer_is_refused_until_the_first_is_gone() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let first = Store::create_or_open(dir.path()).expect("opens");
    let refused = Store::create_or_open(dir.path()).expect_err("locked");
    let expected =
        format!("another slag-encoder is writing to {}; wait for it or stop it", dir.path().display());
    assert_eq!(refused.to_string(), expected);
    drop(first);
    Store::create_or_open(dir.path()).expect("the lock is released with its holder");
}

#[test]
fn objects_are_named_by_content_and_kept() {
    let (dir, store) = new_store();
    let (hash, len_bytes) = store.put_object(|out| (0..1000).try_for_each(|i| write!(out, "{i},"))).unwrap();
    let expected: String = (0..1000).map(|i| format!("{i},")).collect();
    assert_eq!((hash, len_bytes), (Hash32::of(expected.as_bytes()), expected.len() as u64));
    let path = reader::object_path(dir.path(), hash);
    let modified = |path: &Path| fs_err::metadata(path).expect("there").modified().expect("a clock");
    let before = modified(&path);
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| store.put_bytes(expected.as_bytes()).expect("room"));
        }
    });
    assert_eq!(modified(&path), before, "an object that is there is not written again");
    fs_err::write(&path, b"cut").expect("writable");
    store.put_bytes(expected.as_bytes()).expect("room");
    assert_eq!(fs_err::read(&path).expect("there"), expected.as_bytes(), "a cut one is");
    let mut flipped = expected.clone().into_bytes();
    flipped[500] ^= 1;
    fs_err::write(&path, flipped).expect("writable");
    store.put_bytes(expected.as_bytes()).expect("room");
    assert_eq!(fs_err::read(&path).unwrap(), expected.as_bytes(), "a damaged one of the same length, too");

    let failed = store.put_object(|out| {
        out.write_all(b"half")?;
        Err(io::Error::other("the callback failed"))
    });
    assert!(failed.is_err_and(|e| e.to_string().contains("the callback failed")));
    assert_eq!(fs_err::read_dir(dir.path().join("tmp")).expect("folder").count(), 0);
}

#[test]
fn what_is_not_whole_is_not_published() {
    let (dir, store) = new_store();
    let shards = put_many(&store, &["a"]);
    let nothing = Hash32::of(b"never put");
    let missing =
        |result: Result<Hash32, StoreError>| matches!(result, Err(StoreError::MissingObject { .. }));
    assert!(missing(store.publish(&manifest(1, &[(nothing, 1)]), &Extras::new())));
    assert!(missing(store.publish(&manifest(1, &[(shards[0].0, 2)]), &Extras::new())));
    let extras = Extras::from([("field".to_owned(), nothing)]);
    assert!(missing(store.publish(&manifest(1, &shards), &extras)));
    let path = reader::object_path(dir.path(), shards[0].0);
    fs_err::write(&path, b"b").expect("writable");
    drop(store);
    let store = Store::create_or_open(dir.path()).expect("opens");
    let damaged = store.publish(&manifest(1, &shards), &Extras::new());
    assert!(matches!(damaged, Err(StoreError::ObjectHash { .. })), "{damaged:?}");
    fs_err::write(&path, b"a").expect("writable");
    let mut hostile = manifest(1, &shards);
    hostile.cells.push(hostile.cells[0].clone());
    assert!(matches!(store.publish(&hostile, &Extras::new()), Err(StoreError::Manifest { .. })));
    assert!(matches!(store.reader(), Err(StoreError::NotPublished { .. })), "nothing was replaced");

    store.publish(&manifest(5, &shards), &Extras::new()).expect("publishes");
    store.publish(&manifest(5, &shards), &Extras::new()).expect("the same again is no error");
    assert!(store.reader().expect("published").previous().is_none(), "and is not its own predecessor");
    let back = Manifest { created_unix_secs: 2, ..manifest(5, &shards) };
    let refused = store.publish(&back, &Extras::new());
    assert!(matches!(refused, Err(StoreError::Generation { found: 5, current: 5 })));
    assert_eq!(store.next_generation().expect("records"), 6);
}

#[test]
fn prune_keeps_two_generations_with_their_extras() {
    let (dir, store) = new_store();
    let all = put_many(&store, &["s1", "s2", "s3", "f1", "f2", "f3", "loose"]);
    for generation in 1..=3usize {
        let extras = Extras::from([("field".to_owned(), all[2 + generation].0)]);
        let shards = &all[generation - 1..generation];
        store.publish(&manifest(generation as u64, shards), &extras).expect("publishes");
    }
    assert_eq!(object_names(&store).len(), 7);
    assert_eq!(store.prune().expect("readable").n_files, 3);
    let kept: BTreeSet<String> = [1, 2, 4, 5].map(|i: usize| all[i].0.to_string()).into();
    assert_eq!(object_names(&store), kept);
    assert_eq!(fs_err::read_dir(dir.path().join("extras")).expect("folder").count(), 2);

    fs_err::remove_file(reader::extras_path(dir.path(), store.reader().expect("published").current().hash))
        .expect("there");
    assert!(store.prune().is_err(), "what it cannot know, it does not delete");
    assert_eq!(object_names(&store), kept);
}

#[test]
fn records_behind_the_manifest_are_repaired() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let shards;
    {
        let store = Store::create_or_open(dir.path()).expect("opens");
        shards = put_many(&store, &["a", "b", "c"]);
        store.publish(&manifest(1, &shards), &Extras::new()).expect("publishes");
        // A crash between the manifest's rename and the records' flush leaves exactly this.
        let signed = manifest(2, &shards[1..]).to_bytes();
        store.replace(&reader::extras_path(dir.path(), Hash32::of(&signed)), b"{}").expect("writable");
        store.replace(&dir.path().join("manifest"), &signed).expect("writable");
        fs_err::write(dir.path().join("tmp/9.part"), b"left over").expect("writable");
    }
    assert_eq!(Store::create_or_open(dir.path()).expect("opens").next_generation().expect("records"), 3);
    assert_eq!(fs_err::read_dir(dir.path().join("tmp")).expect("folder").count(), 0);
}

/// Each step but the last can fail and leaves the previous generation whole, so a crash there is harmless, too.
#[test]
fn publication_that_fails_on_its_way_changes_nothing() {
    for obstacle in ["extras", "manifest.previous"] {
        let (dir, store) = new_store();
        let shards = put_many(&store, &["a", "b"]);
        let hash = store.publish(&manifest(1, &shards[..1]), &Extras::new()).expect("publishes");
        // A file cannot be written below a file, nor renamed onto a folder that is not empty.
        let (path, aside) = (dir.path().join(obstacle), dir.path().join("aside"));
        match obstacle {
            "extras" => {
                fs_err::rename(&path, &aside).expect("renames");
                fs_err::write(&path, b"").expect("writable");
            }
            _ => fs_err::create_dir_all(path.join("inside")).expect("room"),
        }
        let failed = store.publish(&manifest(2, &shards[1..]), &Extras::new());
        assert!(matches!(failed, Err(StoreError::Io(_))), "{obstacle}: {failed:?}");
        if obstacle == "extras" {
            fs_err::remove_file(&path).expect("there");
            fs_err::rename(&aside, &path).expect("renames");
        } else {
            fs_err::remove_dir_all(&path).expect("there");
        }
        assert_eq!(store.reader().expect("published").current().hash, hash, "{obstacle}");
        assert_eq!(store.next_generation().expect("records"), 2, "{obstacle}");
        store.publish(&manifest(2, &shards[1..]), &Extras::new()).expect("publishes, once it can");
    }
}

/// Publishes without end, in a process that the test below kills.
#[test]
#[ignore = "the process that the kill test starts"]
fn publish_until_killed() {
    let Some(dir) = std::env::var_os("SLAG_TEST_STORE") else { return };
    let store = Store::create_or_open(Path::new(&dir)).expect("opens");
    loop {
        let generation = store.next_generation().expect("records");
        let texts: Vec<String> = (0..4).map(|i| format!("shard {i} of {generation}")).collect();
        let shards = put_many(&store, &texts);
        let field = store.put_bytes(format!("field of {generation}").as_bytes()).expect("room").0;
        let extras = Extras::from([("field".to_owned(), field)]);
        store.publish(&manifest(generation, &shards), &extras).expect("publishes");
        store.prune().expect("prunes");
    }
}

/// SIGKILL at any moment leaves a whole generation, none older than seen before.
#[test]
fn killed_writer_leaves_a_whole_generation() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let mut last_generation = 0;
    for round in 0..12u64 {
        let mut child = std::process::Command::new(std::env::current_exe().expect("this test"))
            .args(["--exact", "store::tests::publish_until_killed", "--include-ignored", "--quiet"])
            .env("SLAG_TEST_STORE", dir.path())
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::null())
            .spawn()
            .expect("starts");
        // Waits for at least one more generation, then kills at a spread of phases.
        while !StoreReader::open(dir.path()).is_ok_and(|r| r.manifest().generation > last_generation) {
            assert!(child.try_wait().expect("a child").is_none(), "the writer stopped by itself");
            std::thread::sleep(std::time::Duration::from_micros(500));
        }
        std::thread::sleep(std::time::Duration::from_micros(round * 1_700));
        child.kill().expect("kills");
        child.wait().expect("ends");
        let reader = StoreReader::open(dir.path()).expect("a whole manifest");
        let generation = reader.manifest().generation;
        assert!(generation > last_generation);
        for (hash, _) in reader.current().shard_lens() {
            reader.read_object(hash).expect("a whole shard");
        }
        let field = reader.read_object(reader.current().extras["field"]).expect("a whole extra");
        assert_eq!(&*field, format!("field of {generation}").as_bytes(), "extras of this very generation");
        let store = Store::create_or_open(dir.path()).expect("opens after the kill");
        assert_eq!(store.next_generation().expect("records"), generation + 1);
        last_generation = generation;
    }
}

/// A damaged record of extras hides what robots do not need: it must not keep the next encode from repairing it.
#[test]
fn damaged_extras_do_not_keep_a_writer_out() {
    let (dir, store) = new_store();
    let object = store.put_bytes(b"shard").expect("puts");
    let hash = store.publish(&manifest(1, &[object]), &Extras::new()).expect("publishes");
    drop(store);
    fs_err::write(reader::extras_path(dir.path(), hash), "{").expect("damages");
    assert!(matches!(StoreReader::open(dir.path()), Err(StoreError::Extras { .. })));
    let store = Store::create_or_open(dir.path()).expect("opens all the same");
    assert_eq!(store.next_generation().expect("counts"), 2);
    store.publish(&manifest(2, &[object]), &Extras::new()).expect("publishes");
    store.prune().expect("prunes");
    assert_eq!(StoreReader::open(dir.path()).expect("reads").manifest().generation, 2);
}

/// A record of another encoder, from an interrupted encode, says nothing of what is published.
#[test]
fn models_are_remembered_for_their_encoder_alone() {
    let (_dir, store) = new_store();
    let manifest = manifest(1, &[]);
    store.publish(&manifest, &Extras::new()).expect("publishes");
    let models = || store.reader().expect("reads").models().expect("reads");
    assert_eq!(models(), None);
    let record = ModelsRecord { encoder: manifest.encoder.id, models: Some("clip".into()) };
    store.remember_models(&record).expect("writes");
    assert_eq!(models(), Some(record.clone()));
    store.remember_models(&ModelsRecord { encoder: Hash32([9; 32]), ..record }).expect("writes");
    assert_eq!(models(), None);
}

#[test]
fn verification_reads_every_byte_and_names_what_is_bad() {
    let (dir, store) = new_store();
    let all = put_many(&store, &["shard one", "shard two", "field", "unlisted"]);
    let extras = Extras::from([("field".to_owned(), all[2].0)]);
    store.publish(&manifest(1, &all[..1]), &extras).expect("publishes");
    store.publish(&manifest(2, &all[1..2]), &Extras::new()).expect("publishes");
    let verify = || {
        let n_read = std::sync::atomic::AtomicU64::new(0);
        let reader = store.reader().expect("published");
        let verified = reader.verify(|| {
            n_read.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        });
        assert_eq!((verified.n_files, n_read.into_inner()), (3, 3));
        verified
    };
    let sound = verify();
    assert_eq!((sound.bad.len(), sound.len_bytes), (0, all[..3].iter().map(|(_, n)| n).sum()));
    let path = |at: usize| reader::object_path(dir.path(), all[at].0);
    fs_err::write(path(1), b"shard twO").expect("writable");
    fs_err::remove_file(path(2)).expect("there");
    let mut bad: Vec<_> = verify().bad.into_iter().map(|bad| (bad.holds, bad.fault)).collect();
    bad.sort_by_key(|(holds, _)| holds.clone());
    let expected =
        [("cell 0, compact, generation 2", Fault::Damaged), ("field, generation 1", Fault::Missing)];
    assert_eq!(bad, expected.map(|(holds, fault)| (vec![holds.to_owned()], fault)));
}

/// A manifest that is cut, empty, changed or lost: readers say what helps, and the next encode does it. Fetches under
/// way keep the previous generation.
#[test]
fn a_damaged_manifest_is_published_anew() {
    for (number, damage) in DAMAGES.iter().enumerate() {
        let (dir, store) = new_store();
        for generation in 1..=2 {
            store.publish(&manifest(generation, &[]), &Extras::new()).expect("publishes");
        }
        drop(store);
        damage(&dir.path().join("manifest"));
        let error = StoreReader::open(dir.path()).expect_err("damaged");
        assert!(matches!(error, StoreError::Manifest { .. } | StoreError::ManifestLost { .. }), "{error}");
        let text = error.to_string();
        assert!(text.contains("run `slag-encoder encode` again"), "damage {number}: {text}");
        assert!(!text.contains("matching versions") && !text.contains("nothing has been"), "{text}");
        let store = Store::create_or_open(dir.path()).expect("an encode goes on");
        assert_eq!(store.next_generation().expect("records"), 3, "damage {number}");
        store.publish(&manifest(3, &[]), &Extras::new()).expect("publishes");
        let reader = store.reader().expect("whole");
        let previous = reader.previous().expect("readable").manifest.generation;
        assert_eq!((reader.manifest().generation, previous), (3, 1), "damage {number}");
        assert!(reader.verify(|| {}).bad.is_empty(), "damage {number}");
    }
}

/// What another version wrote is no damage, and is not overwritten.
#[test]
fn a_manifest_of_another_version_is_kept() {
    let (dir, store) = new_store();
    store.publish(&manifest(1, &[]), &Extras::new()).expect("publishes");
    drop(store);
    let path = dir.path().join("manifest");
    let ours = fs_err::read_to_string(&path).expect("there");
    let later = ours.replace(&format!("{{\"version\":{VERSION}"), &format!("{{\"version\":{}", VERSION + 1));
    fs_err::write(&path, later).expect("written");
    let refused = Store::create_or_open(dir.path()).expect_err("another version");
    assert!(refused.to_string().contains("matching versions"), "{refused}");
    // The same version number with a signed member that this program does not know.
    let later = ours.replacen('{', "{\"later\":1,", 1);
    fs_err::write(&path, &later).expect("written");
    Store::create_or_open(dir.path()).expect("it is not signed: damage");
    Metadata::open(dir.path()).and_then(|metadata| metadata.publish(later.as_bytes(), 1)).expect("signs");
    let refused = Store::create_or_open(dir.path()).expect_err("another version");
    assert!(matches!(refused, StoreError::SignedManifest { .. }), "{refused}");
    assert!(fs_err::read_to_string(&path).expect("there") == later);
}

/// A folder of other files is left as it is; a store that was begun goes on.
#[test]
fn a_folder_of_other_files_is_no_store() {
    let dir = tempfile::tempdir().expect("a folder");
    fs_err::create_dir_all(dir.path().join("tmp")).expect("made");
    for name in ["photo.jpg", "tmp/notes"] {
        fs_err::write(dir.path().join(name), "kept").expect("written");
    }
    assert_error(Store::create_or_open(dir.path()), &["photo.jpg", "name a store"]);
    assert_eq!(fs_err::read_dir(dir.path()).expect("listed").count(), 2);
    assert!(dir.path().join("tmp/notes").exists());

    let begun = tempfile::tempdir().expect("a folder");
    fs_err::create_dir(begun.path().join("objects")).expect("made");
    Store::create_or_open(begun.path()).expect("goes on");
}

/// Files and folders of others within a store's folders stay, and are no error.
#[test]
fn files_of_others_stay_in_a_store() {
    let dir = tempfile::tempdir().expect("a folder");
    let others =
        ["notes", "tmp/notes", "tmp/a.part/b", "objects/notes", "objects/ab/notes", "extras/folder/b"];
    let store = Store::create_or_open(dir.path()).expect("opens");
    store.publish(&manifest(1, &[]), &Extras::new()).expect("publishes");
    let unlisted = store.put_bytes(b"unlisted").expect("room").0;
    drop(store);
    for path in others.map(|name| dir.path().join(name)) {
        fs_err::create_dir_all(path.parent().expect("a folder")).expect("made");
        fs_err::write(path, "kept").expect("written");
    }
    assert_eq!(Store::create_or_open(dir.path()).expect("opens").prune().expect("prunes").n_files, 1);
    assert!(!reader::object_path(dir.path(), unlisted).exists());
    assert!(others.iter().all(|name| dir.path().join(name).exists()));
}

/// What is lost is named, and the next publication makes it anew.
#[test]
fn lost_extras_and_objects_are_named() {
    let dir = tempfile::tempdir().expect("a folder");
    let publish = |generation| {
        let store = Store::create_or_open(dir.path()).expect("opens");
        let object = store.put_bytes(b"shard").expect("puts");
        store.publish(&manifest(generation, &[object]), &Extras::new()).expect("publishes");
        object.0
    };
    let object = publish(1);
    fs_err::remove_dir_all(dir.path().join("objects")).expect("there");
    let reader = StoreReader::open(dir.path()).expect("reads");
    assert_error(reader.read_object(object), &["it is missing; encode again"]);
    fs_err::remove_dir_all(dir.path().join("extras")).expect("there");
    assert_error(StoreReader::open(dir.path()), &["it is missing; encode again"]);
    publish(2);
    StoreReader::open(dir.path()).expect("reads").read_object(object).expect("is there again");
}

/// Robots that fetch from a folder follow one store.
#[test]
fn an_export_replaces_nothing_else() {
    let [dir, other] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
    for dir in [&dir, &other] {
        let store = Store::create_or_open(dir.path()).expect("opens");
        store.publish(&manifest(1, &[]), &Extras::new()).expect("publishes");
    }
    let out = tempfile::tempdir().expect("a folder");
    let at = |name: &str| out.path().join("v1").join(name);
    for name in ["objects/.nfs1", "objects/notes", "objects/folder/b", "index"] {
        fs_err::create_dir_all(at(name).parent().expect("a folder")).expect("made");
        fs_err::write(at(name), "kept").expect("written");
        let exported = export(dir.path(), out.path());
        if name == "objects/.nfs1" {
            exported.expect("hidden files may lie there");
            continue;
        }
        assert_error(exported, &["no export of a store has this"]);
        match fs_err::remove_file(at(name)) {
            Ok(()) if name.ends_with("/b") => fs_err::remove_dir(at("objects/folder")).expect("empty"),
            removed => removed.expect("there"),
        }
    }
    assert_error(export(other.path(), out.path()), &["1.root.json: robots follow another store here"]);
    export(dir.path(), out.path()).expect("the same store");
}

/// A full or read-only disk is no damaged database.
#[test]
fn advice_fits_the_fault_of_the_disk() {
    let said = |error: io::Error| {
        let path = PathBuf::from("db");
        let of_files = StoreError::Io(io::Error::new(error.kind(), error.to_string())).to_string();
        (of_files, StoreError::Records { path, cause: sled::Error::Io(error) }.to_string())
    };
    for (error, expected) in [
        (io::Error::from(io::ErrorKind::StorageFull), "free space"),
        (io::Error::other("No space left on device (os error 28)"), "free space"),
        (io::Error::from(io::ErrorKind::PermissionDenied), "the right to read and write"),
        (io::Error::from(io::ErrorKind::ReadOnlyFilesystem), "takes no writes"),
    ] {
        let (of_files, of_records) = said(error);
        assert!(of_files.contains(expected) && of_records.contains(expected), "{of_files}; {of_records}");
        assert!(!of_records.contains("remove this folder"), "{of_records}");
    }
    let (_, damaged) = said(io::Error::from(io::ErrorKind::InvalidData));
    assert!(damaged.contains("remove this folder"), "{damaged}");
}
