//! A rotten store: another encode rewrites its files from the kept views, and its catalogue from the files.

use super::*;

use slag_tests::*;

#[test]
fn an_encode_heals_a_store_from_kept_views() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (room, store) = (dir.path().join("room"), dir.path().join("store"));
    run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", "4"]));
    let command = || {
        let mut command = encode_room(&room, &store);
        command.args(["--models", "colours", "--device", "cpu", "--keep-views"]);
        command
    };
    let encode = || {
        let output = command().output().expect("runs");
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{errors}");
        (serde_json::from_slice::<serde_json::Value>(&output.stdout).expect("JSON"), errors)
    };
    let json = |name: &str| -> (bool, serde_json::Value) {
        let output = encoder(&["store", name, "--store", text(&store), "--json"]).output().expect("runs");
        (output.status.success(), serde_json::from_slice(&output.stdout).expect("JSON"))
    };
    encode();
    // Reading commands write nothing, and leave another writer's temporary files.
    fs_err::write(store.join("tmp/7.part"), "of a writer").expect("written");
    let untouched = files(&store);
    run(&mut encoder(&["keys", "status", "--store", text(&store)]));
    let listed = json("ls").1;
    assert_eq!((&listed["history"][0]["generation"], &listed["job"]["n_views"]), (&1.into(), &4.into()));
    assert!(json("verify").0);
    assert!(files(&store) == untouched, "a command that reads wrote");

    // A flipped byte, missing files, and an object that only queries here need.
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
    // The database, the metadata and the list of fields rot as well, and a foreign file lies in a folder.
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
    fs_err::remove_file(store.join("objects/stray")).expect("it stays");
    let (is_whole, verified) = json("verify");
    assert!(is_whole, "{verified}");
    assert_eq!(content(&store), before);
    run(&mut encoder(&["query", "blue", "--store", text(&store), "--models", "colours"]));

    // Kept views rot: one is cut, one is missing, one has a wrong byte among its contributions, found on reading.
    let mut kept = files_below(&store.join("job/views"));
    kept.retain(|path| path.extension().is_some_and(|extension| extension == "contributions"));
    let bytes = fs_err::read(&kept[0]).expect("there");
    fs_err::write(&kept[0], &bytes[..bytes.len() / 2]).expect("written");
    fs_err::remove_file(kept[1].with_extension("outlines")).expect("there");
    let mut bytes = fs_err::read(&kept[2]).expect("there");
    *bytes.last_mut().expect("some") ^= 1;
    fs_err::write(&kept[2], bytes).expect("written");
    let said = refused(&mut command(), "run the same encode again: this view is made again");
    assert_eq!(said.matches(" is made again: ").count(), 2, "{said}");
    // So does the manifest.
    let manifest = fs_err::read(store.join("manifest")).expect("there");
    fs_err::write(store.join("manifest"), &manifest[..manifest.len() / 2]).expect("written");
    let (summary, errors) = encode();
    assert_eq!((&summary["n_views_resumed"], &summary["generation"]), (&3.into(), &3.into()), "{errors}");
    assert!(errors.contains("it is damaged"), "{errors}");
    assert!(json("verify").0);
    assert_eq!(content(&store), before);

    // What robots would refuse is reported, and no robot gets it.
    let targets = store.join("metadata/1.targets.json");
    let newest = (1..).map(|n| targets.with_file_name(format!("{n}.targets.json")));
    let newest = newest.take_while(|path| path.exists()).last().expect("signed");
    fs_err::write(&newest, "{").expect("written");
    let (is_whole, verified) = json("verify");
    assert!(!is_whole && verified["bad"][0]["path"] == text(&newest), "{verified}");
    let out = dir.path().join("out");
    let export = || encoder(&["store", "export", "--store", text(&store), "--out", text(&out)]);
    refused(&mut export(), "slag-encoder store refresh");
    run(&mut encoder(&["store", "refresh", "--store", text(&store)]));
    assert!(json("verify").0);
    run(&mut export());
    let nothing = ["view", "--store", text(&out), "--no-open", "--listen", "127.0.0.1:0"];
    refused(&mut encoder(&nothing), "nothing has been published here yet");
}

fn a_field(store: &Path) -> String {
    let mut entries = fs_err::read_dir(store.join("extras")).expect("there");
    let extras = entries.next().expect("one").expect("readable").path();
    let extras: serde_json::Value = serde_json::from_slice(&fs_err::read(extras).unwrap()).unwrap();
    let hash = extras.as_object().expect("a map").values().next().and_then(|hash| hash.as_str());
    hash.expect("a hash").to_owned()
}

fn files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let read = |path: PathBuf| (path.clone(), fs_err::read(path).expect("readable"));
    files_below(folder).into_iter().map(read).collect()
}
