//! Rotates a store's key while robots fetch, with the real programs.

use std::path::Path;

use slag_tests::*;

#[test]
fn robots_follow_a_change_of_keys() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (room, store) = (dir.path().join("room"), dir.path().join("store"));
    let keys =
        |args: &[&str]| run_json(&mut encoder(&[&["keys"], args, &["--store", text(&store)]].concat()));
    let first = keys(&["generate"])["present"].clone();
    assert!(
        !encoder(&["keys", "generate", "--store", text(&store)]).output().expect("runs").status.success()
    );
    let nowhere = dir.path().join("nowhere");
    assert!(
        !encoder(&["keys", "rotate", "--store", text(&nowhere)]).output().expect("runs").status.success()
    );
    assert!(!nowhere.exists(), "a typing error makes no store");

    run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", "3"]));
    run(&mut encode_room(&room, &store));
    let service = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    let fetch = |cache: &Path, keys: &[&str]| {
        let mut command = edge(&["fetch", "--from", &service.url, "--at", "3.5,2.7,0", "--radius", "50"]);
        command.args(["--cache", text(cache)]).args(keys.iter().flat_map(|key| ["--key", key]));
        command
    };
    let (follows, sleeps) = (dir.path().join("follows"), dir.path().join("sleeps"));
    let pinned = first.as_str().expect("text");
    for cache in [&follows, &sleeps] {
        assert_eq!(run_json(&mut fetch(cache, &[pinned]))["key"], first);
    }

    let begun = keys(&["rotate"]);
    let second = begun["next"].clone();
    assert_eq!(begun["present"], first);
    let report = run_json(&mut fetch(&follows, &[pinned]));
    assert_eq!((&report["key"], &report["next_key"], &report["generation"]), (&first, &second, &2.into()));
    let finished = keys(&["rotate", "--finish"]);
    assert_eq!((&finished["present"], &finished["previous"]), (&second, &first));
    assert_eq!(keys(&["show"]), finished);
    // The robot that fetched during the rotation goes on, although its command line names the old key.
    let report = run_json(&mut fetch(&follows, &[pinned]));
    assert_eq!((&report["key"], &report["replaced_key"]), (&second, &first));
    assert_eq!(report["downloaded"]["n_shards"], 0, "the shards are the same");
    let query =
        |cache: &Path| run_json(&mut edge(&["query", "blue", "--cache", text(cache)]))["answers"].clone();
    assert_eq!(query(&follows), query(&sleeps));
    // The robot that slept is given both keys.
    let refused = fetch(&sleeps, &[pinned]).output().expect("runs");
    assert!(String::from_utf8_lossy(&refused.stderr).contains("is signed by key"));
    let both = [pinned, second.as_str().expect("text")];
    assert_eq!(run_json(&mut fetch(&sleeps, &both))["key"], second);
}
