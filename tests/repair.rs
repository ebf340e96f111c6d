//! A store that rots: its files are made again from what the encode kept, and its catalogue from the files.

use std::path::Path;

use slag_tests::*;

#[test]
fn a_store_is_repaired_from_kept_views() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (room, store) = (dir.path().join("room"), dir.path().join("store"));
    run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", "4"]));
    // Its paths are relative to its own folder, not to that of the repair.
    run(encode_room(Path::new("room"), Path::new("store")).current_dir(dir.path()).args([
        "--models",
        "colours",
        "--device",
        "cpu",
        "--keep-views",
    ]));
    let command = |name: &str| {
        let mut command = encoder(&["store", name, "--store", text(&store), "--json"]);
        command.current_dir("/");
        command
    };
    let json = |name: &str| -> (bool, serde_json::Value) {
        let output = command(name).output().expect("runs");
        (output.status.success(), serde_json::from_slice(&output.stdout).expect("JSON"))
    };
    let manifest = fs_err::read(store.join("manifest")).expect("published");
    let listed = json("ls").1;
    assert_eq!((&listed["history"][0]["generation"], &listed["job"]["n_views"]), (&1.into(), &4.into()));
    assert_eq!(listed["history"][0]["command"]["words"][1], "encode");
    let (is_whole, repaired) = json("repair");
    assert!(is_whole && repaired["mended"] == serde_json::json!([]), "{repaired}");

    // A byte that rots, and files that are gone: a shard of each profile, and an object that only queries here need.
    let before = content(&store);
    let path = |hash: &str| store.join("objects").join(&hash[..2]).join(hash);
    let hashes: Vec<&str> = before.iter().map(|(_, hash)| hash.trim_matches('"')).collect();
    let mut rotten = fs_err::read(path(hashes[0])).expect("there");
    let middle = rotten.len() / 2;
    rotten[middle] ^= 4;
    fs_err::write(path(hashes[0]), rotten).expect("written");
    for hash in &hashes[1..3] {
        fs_err::remove_file(path(hash)).expect("there");
    }
    let extras =
        fs_err::read_dir(store.join("extras")).expect("there").next().expect("one").expect("readable");
    let extras: serde_json::Value =
        serde_json::from_slice(&fs_err::read(extras.path()).expect("there")).expect("JSON");
    let field =
        extras.as_object().expect("a map").values().next().and_then(|hash| hash.as_str()).expect("a hash");
    fs_err::write(path(field), b"").expect("written");
    assert_eq!(json("verify").1["bad"].as_array().map(Vec::len), Some(4));
    // The database is damaged as well: then the command is not known, and nothing is made again.
    let (db, aside) = (store.join("db"), dir.path().join("db"));
    copy_dir(&db, &aside);
    for entry in fs_err::read_dir(&db).expect("there") {
        let path = entry.expect("readable").path();
        if path.is_file() {
            fs_err::write(path, vec![0x5A; 3000]).expect("written");
        }
    }
    let (is_whole, repaired) = json("repair");
    assert!(!is_whole && repaired["bad"].as_array().map(Vec::len) == Some(4), "{repaired}");
    assert!(repaired["failure"].as_str().expect("a reason").contains("is not known"), "{repaired}");
    fs_err::remove_dir_all(&db).expect("there");
    copy_dir(&aside, &db);

    let (is_whole, repaired) = json("repair");
    assert!(is_whole && repaired["mended"].as_array().map(Vec::len) == Some(4), "{repaired}");
    assert!(json("verify").0);
    assert_eq!(fs_err::read(store.join("manifest")).expect("published"), manifest, "nothing was published");
    assert_eq!(content(&store), before);
    run(&mut encoder(&["query", "blue", "--store", text(&store), "--models", "colours"]));

    // Without kept views, repair says so and leaves all as it is.
    fs_err::remove_dir_all(store.join("job")).expect("there");
    fs_err::remove_dir_all(&db).expect("there");
    run(encode_room(&room, &store).args(["--models", "colours", "--device", "cpu"]));
    fs_err::remove_file(path(hashes[0])).expect("there");
    let (is_whole, repaired) = json("repair");
    assert!(!is_whole, "{repaired}");
    assert!(repaired["failure"].as_str().expect("a reason").contains("--keep-views"), "{repaired}");
}
