//! Pulling models from a hub on this machine that behaves like the real one, or worse.

mod segmenter;
mod server;

use std::path::{Path, PathBuf};

use crate::common::options;
use slag_models::hub::{Here, Hub, HubError, Side, Source};
use slag_models::{ModelDir, SessionOptions};
use slag_test_support::assert_error;

use server::*;

fn is_told(error: &HubError, parts: [&str; 2]) -> bool {
    parts.iter().all(|part| error.to_string().contains(part))
}

#[test]
fn a_pulled_model_is_checked_described_and_pulled_once() {
    let (server, root, _) = setting();
    let hub = hub_of(&pinned(&server), &server.url, root.path());
    let pulled = hub.pull("made", Side::Both, true).expect("it is pulled");
    let words: Vec<_> =
        pulled.iter().map(|file| (file.path.as_str(), file.hash_source, file.was_here)).collect();
    let expected = [
        ("onnx/vision.onnx", Source::Hub, false),
        ("onnx/text.onnx", Source::Table, false),
        ("tokenizer.json", Source::FirstPull, false),
    ];
    assert_eq!(words, expected);
    for file in &pulled {
        let found = fs_err::read(root.path().join("made").join(&file.path)).expect("it is there");
        assert_eq!((found == server.bytes(&file.path), file.sha256.to_string()), (true, sha256(&found)));
    }
    let names = ["made/model.toml", "made/onnx/text.onnx", "made/onnx/vision.onnx", "made/tokenizer.json"];
    assert_eq!(files_below(root.path()), names.map(PathBuf::from));
    let lock = lock_of(root.path());
    assert_eq!([&lock["made"]["licence"], &lock["made"]["revision"]], ["Example-1.0", COMMIT]);
    assert_eq!(lock["made"]["files"]["tokenizer.json"]["hash_source"], "first-pull");
    assert_eq!(hub.here(hub.entry("made").expect("known")), Here::All);

    // A second pull requests nothing and asks for no consent.
    server.asked();
    let again = hub.pull("made", Side::Both, false).expect("it is there");
    assert!(again.iter().all(|file| file.was_here) && server.asked().is_empty());

    let folder = hub.resolve(Path::new("made")).expect("it is here");
    let model = ModelDir::open(&folder).expect("it opens");
    assert_eq!(Hub::verify(&folder).expect("as recorded").len(), 3);
    let options = options();
    assert!(model.text_encoder(&options).expect("it loads").encode("red chair").is_ok());
    assert!(model.image_encoder(&options).is_ok());
    // Both readers detect a changed file.
    let text = folder.join("onnx/text.onnx");
    let mut bytes = fs_err::read(&text).expect("it is readable");
    bytes[40] ^= 1;
    fs_err::write(&text, bytes).expect("it is writable");
    for error in [
        Hub::verify(&folder).expect_err("changed").to_string(),
        hub.pull("made", Side::Both, false).expect_err("changed").to_string(),
        model.text_encoder(&SessionOptions::new("none".into())).err().expect("changed").to_string(),
    ] {
        assert!(error.contains("onnx/text.onnx: SHA-256 is") && error.contains("again"), "{error}");
    }
}

#[test]
fn a_robot_pulls_the_text_side_and_still_knows_the_space() {
    let (server, root, hub) = setting();
    let both = tempfile::tempdir().expect("a folder");
    let pulled = hub.pull("made", Side::Text, true).expect("it is pulled");
    let found = pulled.iter().map(|file| &*file.path).collect::<Vec<_>>();
    assert_eq!(found, ["onnx/text.onnx", "tokenizer.json"]);
    assert!(server.asked().iter().all(|asked| asked.method == "HEAD" || !asked.path.contains("vision")));
    assert_eq!(hub.here(hub.entry("made").expect("known")), Here::Text);
    assert_eq!(Hub::verify(&root.path().join("made")).expect("as recorded").len(), 2);
    let robot = ModelDir::open(&root.path().join("made")).expect("it opens");
    hub_of(&table(), &server.url, both.path()).pull("made", Side::Both, true).expect("it is pulled");
    let cloud = ModelDir::open(&both.path().join("made")).expect("it opens");
    assert_eq!(robot.encoder_id(), cloud.encoder_id());
    // Without the hub's hash there is no encoder id.
    let bare = tempfile::tempdir().expect("a folder");
    server.change(|files| {
        files.stated.insert("onnx/vision.onnx".into(), "no hash".into());
    });
    let error = hub_of(&table(), &server.url, bare.path()).pull("made", Side::Text, true).unwrap_err();
    assert!(error.to_string().contains("no SHA-256 of the image model"), "{error}");
}

#[test]
fn a_cut_pull_goes_on_where_it_ended() {
    let (server, root, hub) = setting();
    // Every body ends after 100 bytes: attempts go on, because each makes progress.
    server.change(|files| files.cut_bytes = 100);
    hub.pull("made", Side::Both, true).expect("piece by piece");
    let asked = server.asked();
    let text = server.bytes("onnx/text.onnx");
    let ranges: Vec<_> = asked
        .iter()
        .filter(|a| a.path == "/store/onnx/text.onnx")
        .filter_map(|a| a.headers.get("range"))
        .collect();
    let expected: Vec<String> = (100..text.len()).step_by(100).map(|at| format!("bytes={at}-")).collect();
    assert_eq!(ranges, expected.iter().collect::<Vec<_>>());
    assert_eq!(fs_err::read(root.path().join("made/onnx/text.onnx")).expect("it is there"), text);

    // The same over two runs of the program: the first one left a part.
    let root = tempfile::tempdir().expect("a folder");
    let hub = hub_of(&table(), &server.url, root.path());
    fs_err::create_dir_all(root.path().join("made/onnx")).expect("it is writable");
    let vision = server.bytes("onnx/vision.onnx");
    let part = root.path().join("made/onnx/vision.onnx.part");
    fs_err::write(&part, &vision[..120]).expect("it is writable");
    let etag = format!("\"{}-{}\"", "onnx/vision.onnx".len(), &sha256(&vision)[..8]);
    fs_err::write(part.with_extension("etag"), etag).expect("it is writable");
    server.change(|files| files.cut_bytes = usize::MAX);
    server.asked();
    hub.pull("made", Side::Both, true).expect("the rest");
    let stored: Vec<Asked> = server.asked().into_iter().filter(|a| a.path.starts_with("/store/")).collect();
    let ranges: Vec<_> = stored.iter().filter_map(|a| a.headers.get("range")).collect();
    assert_eq!(ranges, ["bytes=120-"]);
    assert_eq!(files_below(root.path()).len(), 4, "no part is left: {:?}", files_below(root.path()));
}

#[test]
fn downloads_with_another_hash_are_discarded() {
    let (server, root, hub) = setting();
    // The hub's hash differs from that of the store's bytes.
    server.change(|files| {
        files.stated.insert("onnx/vision.onnx".into(), sha256(b"something else"));
    });
    let error = hub.pull("made", Side::Both, true).expect_err("wrong").to_string();
    let vision = server.bytes("onnx/vision.onnx");
    for part in
        ["vision.onnx: SHA-256 is", &sha256(&vision), &sha256(b"something else"), "advertised by the hub"]
    {
        assert!(error.contains(part), "{error}");
    }
    assert_eq!(files_below(root.path()), Vec::<PathBuf>::new());

    // The program's hash differs from the hub's: nothing is downloaded.
    server.change(|files| files.stated.clear());
    let table = pinned(&server);
    server.change(|files| files.bytes.get_mut("onnx/text.onnx").expect("it is there").push(0));
    server.asked();
    let error = hub_of(&table, &server.url, root.path()).pull("made", Side::Text, true).expect_err("wrong");
    assert!(is_told(&error, ["the hub advertises SHA-256", "(known to this program)"]), "{error}");
    assert!(server.asked().iter().all(|asked| asked.method == "HEAD"));

    // Lengths: more than the program knows; a body that goes on.
    let longer = table.replace("len_bytes = ", "len_bytes = 1");
    server.change(|files| {
        files.bytes.get_mut("onnx/text.onnx").expect("it is there").pop();
    });
    let error = hub_of(&longer, &server.url, root.path()).pull("made", Side::Text, true).expect_err("wrong");
    assert!(error.to_string().contains("bytes, expected 1"), "{error}");
    server.change(|files| files.extra_bytes = 7);
    let error = hub_of(&table, &server.url, root.path()).pull("made", Side::Text, true).expect_err("wrong");
    assert!(error.to_string().contains("bytes, expected"), "{error}");
}

#[test]
fn the_lock_keeps_what_was_accepted_first() {
    let (server, root, hub) = setting();
    hub.pull("made", Side::Both, true).expect("it is pulled");
    let asked = server.asked();
    assert!(asked.iter().any(|asked| asked.path == "/owner/made/resolve/main/onnx/vision.onnx"));
    let remove = |name: &str| fs_err::remove_file(root.path().join("made").join(name)).expect("it is there");

    // A second pull requests the commit of the first.
    remove("tokenizer.json");
    hub.pull("made", Side::Both, false).expect("the same again");
    let path = format!("/owner/made/resolve/{COMMIT}/tokenizer.json");
    assert!(server.asked().iter().all(|asked| asked.path == path));
    // Another tokenizer under the same commit.
    remove("tokenizer.json");
    server.change(|files| files.bytes.get_mut("tokenizer.json").expect("it is there").push(b' '));
    let error = hub.pull("made", Side::Both, false).expect_err("changed");
    assert!(is_told(&error, ["tokenizer.json: SHA-256 is", "(as pulled first"]), "{error}");
    // Another model, which the hub admits.
    remove("onnx/text.onnx");
    server.change(|files| files.bytes.get_mut("onnx/text.onnx").expect("it is there").push(0));
    let error = hub.pull("made", Side::Both, false).expect_err("changed");
    assert!(is_told(&error, ["(advertised by the hub)", "take the model out of models.lock"]), "{error}");
    // Another commit.
    server.change(|files| files.commit = "ffffffffffffffffffffffffffffffffffffffff");
    let error = hub.pull("made", Side::Both, false).expect_err("changed");
    assert!(error.to_string().contains("serves commit ffff"), "{error}");

    fs_err::write(root.path().join("models.lock"), "{").expect("it is writable");
    assert_error(hub.pull("made", Side::Both, false), &["models.lock", "pull again"]);
}

#[test]
fn without_the_hub_the_error_lists_the_files_to_place() {
    let (server, root, _) = setting();
    let table = pinned(&server);
    for (url, status, part) in [
        (server.url.as_str(), Some(404), "the server answered with status 404"),
        (server.url.as_str(), Some(503), "the server answered with status 503"),
        // Nothing listens on port 1.
        ("http://127.0.0.1:1", None, "refused"),
    ] {
        server.change(|files| files.status = status);
        server.asked();
        let error = hub_of(&table, url, root.path()).pull("made", Side::Both, true).expect_err("unreachable");
        // Only transient errors are retried.
        assert_eq!(server.asked().len(), status.map_or(0, |status| if status == 503 { 5 } else { 1 }));
        let text = root.path().join("made/onnx/text.onnx");
        let wanted = format!("{} (SHA-256 {})", text.display(), sha256(&server.bytes("onnx/text.onnx")));
        let unknown = format!("{} (SHA-256 unknown)", root.path().join("made/tokenizer.json").display());
        let error = error.to_string();
        for part in
            [part, &wanted, &unknown, &format!("\n  {url}/owner/made/resolve/main/onnx/text.onnx\n    as ")]
        {
            assert!(error.contains(part), "{error}");
        }
        assert!(error.lines().all(|line| line.len() < 300), "{error}");
    }
    // Files placed by hand make a pulled model without the hub, and the lock records it.
    for name in ["onnx/vision.onnx", "onnx/text.onnx", "tokenizer.json"] {
        let path = root.path().join("made").join(name);
        fs_err::create_dir_all(path.parent().expect("a folder")).expect("it is writable");
        fs_err::write(path, server.bytes(name)).expect("it is writable");
    }
    let hub = hub_of(&table, "http://127.0.0.1:1", root.path());
    let pulled = hub.pull("made", Side::Both, true).expect("all is there");
    let words: Vec<_> = pulled.iter().map(|file| file.hash_source).collect();
    assert_eq!(words, [Source::PlacedByHand, Source::Table, Source::PlacedByHand]);
    assert!(ModelDir::open(&hub.resolve(Path::new("made")).expect("here")).is_ok());
}

#[test]
fn nothing_is_asked_for_before_the_licence_is_accepted() {
    let (server, root, hub) = setting();
    assert_error(
        hub.pull("made", Side::Both, false),
        &["Example-1.0", "https://licence.example/", "Not a real one;", "--accept-licence Example-1.0"],
    );
    assert!(server.asked().is_empty() && files_below(root.path()).is_empty());
    hub.pull("made", Side::Both, true).expect("accepted");
    // Another licence must be accepted again.
    let relicensed = hub_of(&table().replace("Example-1.0", "Example-2.0"), &server.url, root.path());
    assert!(matches!(relicensed.pull("made", Side::Both, false), Err(HubError::Licence { .. })));
    // A licence that does not restrict use needs no consent.
    let open = tempfile::tempdir().expect("a folder");
    let hub = hub_of(&table().replace("restricts_use = true", ""), &server.url, open.path());
    hub.pull("made", Side::Both, false).expect("no consent is needed");
}

#[test]
fn only_names_of_the_table_lead_into_the_cache() {
    let (_server, root, hub) = setting();
    for name in ["../made", "made/", "./made", "/made", "", ".", "MADE", "made\0"] {
        assert_error(hub.pull(name, Side::Both, true), &["there are made"]);
        let path = PathBuf::from(name);
        assert_eq!(hub.resolve(&path).unwrap().as_os_str(), path.as_os_str(), "{name:?}");
    }
    assert_error(hub.resolve(Path::new("made")), &["models pull made"]);
    assert!(files_below(root.path()).is_empty());
    // Descriptions do not lead out of it either.
    let escaping = table().replace("onnx/text.onnx", "../../text.onnx");
    let server = Server::start();
    server.change(|files| {
        let bytes = files.bytes["onnx/text.onnx"].clone();
        files.bytes.insert("../../text.onnx".into(), bytes);
    });
    let hub = hub_of(&escaping, &server.url, root.path());
    drop(hub.pull("made", Side::Text, true));
    assert!(hub.resolve(Path::new("made")).is_err() || ModelDir::open(&root.path().join("made")).is_err());
}
