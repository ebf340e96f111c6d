//! Stores and robots against python-tuf, TUF's reference implementation, both ways.

use super::*;

use slag_tests::*;

#[nightly("installs python-tuf and runs it 40 times")]
fn python_tuf_verifies_stores_and_robots_follow_python_tuf() {
    let python = python_with("tests/python_tuf");
    let dir = tempfile::tempdir().expect("a temporary folder");
    let store = dir.path().join("store");
    encoded_into(&store, &ROOM, &SITE);
    let service = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    python_tuf_verifies(&python, dir.path(), &store, &service);
    a_robot_follows_python_tuf(&python, dir.path(), &store, &service);
}

/// One client of python-tuf with a memory, and new ones that begin with the first root.
fn python_tuf_verifies(python: &Path, dir: &Path, store: &Path, service: &Service) {
    let root = store.join("metadata/1.root.json");
    let length = fs_err::metadata(store.join("manifest")).expect("published").len().to_string();
    let verified = |root: &Path, folder: &str| {
        let folder = dir.join(folder);
        judge(python, "tests/python_tuf/verify.py", &[&service.url, text(root), text(&folder)])
            .trim()
            .to_owned()
    };
    assert_eq!(verified(&root, "lasting"), length, "after the encode");
    let timestamp = store.join("metadata/timestamp.json");
    let old = fs_err::read(&timestamp).expect("published");
    run(&mut encoder(&["store", "refresh", "--store", text(store), "--days", "1"]));
    assert_eq!(verified(&root, "lasting"), length, "after a refresh");
    let refreshed = fs_err::read(&timestamp).expect("published");
    fs_err::write(&timestamp, &old).expect("written");
    assert_eq!(verified(&root, "lasting"), "refused: BadVersionNumberError", "an old timestamp");
    fs_err::write(&timestamp, refreshed).expect("written");
    let rotate = ["keys", "rotate", "root", "targets", "snapshot", "timestamp"];
    run(encoder(&rotate).args(["--store", text(store)]));
    for folder in ["lasting", "new"] {
        assert_eq!(verified(&root, folder), length, "after a change of all keys: {folder}");
    }
    // Also begun with the newest root.
    assert_eq!(verified(&store.join("metadata/2.root.json"), "late"), length);
    // It refuses an old timestamp, and a root with another signature.
    let new = fs_err::read(&timestamp).expect("published");
    fs_err::write(&timestamp, old).expect("written");
    let found = verified(&root, "lasting");
    assert_eq!(found, "refused: UnsignedMetadataError", "an old timestamp by an old key");
    fs_err::write(&timestamp, new).expect("written");
    let forged = fs_err::read_to_string(&root).expect("published");
    let at = forged.find("\"sig\":\"").expect("signed") + 7;
    let digit = if forged[at..].starts_with('1') { "2" } else { "1" };
    let path = dir.join("forged.json");
    fs_err::write(&path, [&forged[..at], digit, &forged[at + 1..]].concat()).expect("written");
    assert_eq!(verified(&path, "forged"), "refused: UnsignedMetadataError");
}

/// A real robot before a repository signed by python-tuf: each attack is refused for its own reason, honest metadata is
/// accepted.
fn a_robot_follows_python_tuf(python: &Path, dir: &Path, store: &Path, service: &Service) {
    let (published, cache) = (dir.join("published"), dir.join("cache"));
    fs_err::create_dir(&published).expect("made");
    fs_err::write(published.join("state"), "first").expect("written");
    let manifest = store.join("manifest");
    let script = root().join("tests/python_tuf/publish.py");
    let args = [text(&script), &service.url, text(&manifest), text(&published)];
    let publisher = Service::start(Command::new(python).args(args));
    let fetch = |state: &str| {
        fs_err::write(published.join("state"), state).expect("written");
        let mut command = edge(&["fetch", "--from", &publisher.url, "--at", "3.5,2.7,0", "--radius", "50"]);
        command.args(["--cache", text(&cache)]);
        command
    };
    let first_root = published.join("1.root.json");
    run(&mut edge(&["trust", "add", "--root", text(&first_root), "--cache", text(&cache)]));
    let unsigned = "0 of its keys signed it, expected 1";
    for (state, expected) in [
        ("first", Ok(1)),
        ("rotated", Ok(2)),
        ("timestamp rolled back", Err("version 1 is offered after 2")),
        ("by a key out of use", Err(unsigned)),
        ("unsigned", Err(unsigned)),
        ("other snapshot", Err("files of different states are mixed")),
        ("snapshot of another version", Err("snapshot metadata: version 3, expected 4")),
        ("targets rolled back", Err("version 1 is offered after 2")),
        ("other targets", Err("targets metadata: version 2, expected 6")),
        ("endless snapshot", Err("7.snapshot.json is longer than")),
        ("endless timestamp", Err("timestamp.json is longer than")),
        ("snapshot missing", Err("8.snapshot.json is missing in the store")),
        ("timestamp expired", Err("timestamp metadata expired at")),
        ("snapshot expired", Err("snapshot metadata expired at")),
        ("targets expired", Err("targets metadata expired at")),
        ("first", Err(unsigned)),
        ("fast-forward", Ok(2)),
        ("honest again", Err("version 12 is offered after 18446744073709551615")),
        ("recovered", Ok(3)),
        ("fast-forward", Err(unsigned)),
        ("root by online keys", Err("root metadata: 0 of its keys signed it, expected 2")),
        ("root by one key", Err("root metadata: 1 of its keys signed it, expected 2")),
        ("latest", Ok(3)),
        ("other file", Err("files of different states are mixed")),
    ] {
        match expected {
            Ok(version) => assert_eq!(run_json(&mut fetch(state))["root_version"], version, "{state}"),
            Err(reason) => drop(refused(&mut fetch(state), reason)),
        }
        // After any refusal, the scene on board answers.
        run(&mut edge(&["query", "blue", "--models", "colours", "--cache", text(&cache)]));
    }
}
