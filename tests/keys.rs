//! First trust and a store's metadata, with the real programs.

use super::*;

use slag_tests::*;

#[test]
fn robots_believe_the_store_that_they_were_told_of() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (store, other) = (dir.path().join("store"), dir.path().join("other"));
    // Two stores with keys of their own.
    encoded_into(&store, &ROOM, &SITE);
    encoded_into(&other, &ROOM, &[]);
    let service = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    let impostor = Service::start(&mut encoder(&["serve", "--store", text(&other)]));
    let fetch = |cache: &Path, from: &Service| {
        let mut command = edge(&["fetch", "--from", &from.url, "--at", "3.5,2.7,0", "--radius", "50"]);
        command.args(["--cache", text(cache)]);
        command
    };
    let add =
        |cache: &Path, how: &[&str]| edge(&[&["trust", "add"], how, &["--cache", text(cache)]].concat());
    let (by_file, by_hash) = (dir.path().join("by-file"), dir.path().join("by-hash"));
    refused(&mut fetch(&by_file, &service), "slag-edge trust add");
    let root = store.join("metadata/1.root.json");
    let added = run_json(&mut add(&by_file, &["--root", text(&root)]));
    let sha256 = added["sha256"].as_str().expect("text");
    let added = run_json(&mut add(&by_hash, &[&service.url, "--sha256", sha256]));
    assert_eq!((&added["version"], &added["is_new"]), (&1.into(), &true.into()));
    for cache in [&by_file, &by_hash] {
        let report = run_json(&mut fetch(cache, &service));
        assert_eq!((&report["root_version"], &report["is_first_contact"]), (&1.into(), &false.into()));
        refused(&mut fetch(cache, &impostor), "timestamp metadata: 0 of its keys signed it");
        let first = ["--trust-first"];
        refused(&mut add(cache, &[&[impostor.url.as_str()][..], &first].concat()), "--replace");
    }

    // A refresh needs no encode, and reaches robots.
    let refreshed = run_json(&mut encoder(&["store", "refresh", "--store", text(&store), "--days", "3"]));
    run(&mut fetch(&by_file, &service));
    let shown = run_json(&mut edge(&["trust", "show", "--cache", text(&by_file)]));
    assert_eq!(shown["expires_unix_secs"], refreshed["expires_unix_secs"]);
    assert_eq!(shown["root_sha256"], sha256);

    // A leaked key: a new root replaces it, and robots follow. Root's keys are elsewhere, so a draft goes there.
    let elsewhere = dir.path().join("elsewhere");
    std::fs::rename(store.join("keys/root"), &elsewhere).expect("moved");
    let status = run_json(&mut encoder(&["keys", "status", "--store", text(&store)]));
    assert_eq!(status["root_sha256"], sha256);
    let keys = status["keys"].as_array().expect("a list");
    let leaked = keys.iter().find(|key| key["role"] == "timestamp").expect("listed");
    let id = leaked["id"].as_str().expect("text");
    let revoked = run_json(&mut encoder(&["keys", "revoke", id, "--store", text(&store)]));
    let draft = revoked["draft"].as_str().expect("a draft");
    refused(&mut encoder(&["keys", "install", draft, "--store", text(&store)]), "keys sign");
    run(&mut encoder(&["keys", "sign", draft, "--root-keys", text(&elsewhere)]));
    let installed = run_json(&mut encoder(&["keys", "install", draft, "--store", text(&store)]));
    assert_eq!(installed["root_version"], 2);
    for cache in [&by_file, &by_hash] {
        assert_eq!(run_json(&mut fetch(cache, &service))["root_version"], 2);
    }
    // Adding the first root again is harmless; new robots may begin with either.
    assert_eq!(run_json(&mut add(&by_file, &[&service.url, "--sha256", sha256]))["is_new"], false);
    assert_eq!(run_json(&mut fetch(&by_file, &service))["root_version"], 2);
    let late = dir.path().join("late");
    let newest = installed["root_sha256"].as_str().expect("text");
    assert_eq!(run_json(&mut add(&late, &[&service.url, "--sha256", newest]))["version"], 2);
    run(&mut fetch(&late, &service));
}
