//! A store that rots: another encode writes its files anew, from the views that are kept, and its catalogue from
//! the files.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use slag_tests::*;

#[test]
fn an_encode_heals_a_store_from_kept_views() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (room, store) = (dir.path().join("room"), dir.path().join("store"));
    run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", "4"]));
    let encode = || {
        let mut command = encode_room(&room, &store);
        let output =
            command.args(["--models", "colours", "--device", "cpu", "--keep-views"]).output().expect("runs");
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{errors}");
        (serde_json::from_slice::<serde_json::Value>(&output.stdout).expect("JSON"), errors)
    };
    let json = |name: &str| -> (bool, serde_json::Value) {
        let output = encoder(&["store", name, "--store", text(&store), "--json"]).output().expect("runs");
        (output.status.success(), serde_json::from_slice(&output.stdout).expect("JSON"))
    };
    encode();
    // Commands that read write nothing, not even away what another writer has in work.
    fs_err::write(store.join("tmp/7.part"), "of a writer").expect("written");
    let untouched = files(&store);
    run(&mut encoder(&["keys", "status", "--store", text(&store)]));
    let listed = json("ls").1;
    assert_eq!((&listed["history"][0]["generation"], &listed["job"]["n_views"]), (&1.into(), &4.into()));
    assert!(json("verify").0);
    assert!(files(&store) == untouched, "a command that reads wrote");

    // A byte that rots, files that are gone, and an object that only queries here need.
    let before = content(&store);
    let path = |hash: &str| store.join("objects").join(&hash[..2]).join(hash);
    // Profiles of few vectors may share a file.
    let hashes: BTreeSet<&str> = before.iter().map(|(_, hash)| hash.trim_matches('"')).collect();
    let hashes: Vec<&str> = hashes.into_iter().collect();
    let mut rotten = fs_err::read(path(hashes[0])).expect("there");
    let middle = rotten.len() / 2;
    rotten[middle] ^= 4;
    fs_err::write(path(hashes[0]), rotten).expect("written");
    for hash in &hashes[1..3] {
        fs_err::remove_file(path(hash)).expect("there");
    }
    fs_err::write(path(&a_field(&store)), b"").expect("written");
    let bad = json("verify").1["bad"].as_array().cloned().expect("a list");
    assert_eq!(bad.len(), 4, "{bad:?}");
    // The database, the metadata and the list of fields rot as well, and a folder holds what is none of the
    // store's.
    for entry in fs_err::read_dir(store.join("db")).expect("there") {
        let path = entry.expect("readable").path();
        if path.is_file() {
            fs_err::write(path, vec![0x5A; 3000]).expect("written");
        }
    }
    fs_err::remove_file(store.join("metadata/timestamp.json")).expect("there");
    fs_err::write(store.join("objects/stray"), "").expect("written");

    let (summary, errors) = encode();
    assert_eq!((&summary["n_views_resumed"], &summary["generation"]), (&4.into(), &2.into()), "{errors}");
    // Only the removal of what no generation needs failed, after the publication.
    assert!(errors.contains("generation 2 is published") && errors.contains("stray"), "{errors}");
    fs_err::remove_file(store.join("objects/stray")).expect("there");
    let (is_whole, verified) = json("verify");
    assert!(is_whole, "{verified}");
    assert_eq!(content(&store), before);
    run(&mut encoder(&["query", "blue", "--store", text(&store), "--models", "colours"]));
}

/// Returns the hash of a published field.
fn a_field(store: &Path) -> String {
    let mut entries = fs_err::read_dir(store.join("extras")).expect("there");
    let extras = entries.next().expect("one").expect("readable").path();
    let extras: serde_json::Value =
        serde_json::from_slice(&fs_err::read(extras).expect("there")).expect("JSON");
    let hash = extras.as_object().expect("a map").values().next().and_then(|hash| hash.as_str());
    hash.expect("a hash").to_owned()
}

fn files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let read = |path: PathBuf| (path.clone(), fs_err::read(path).expect("readable"));
    files_below(folder).into_iter().map(read).collect()
}
