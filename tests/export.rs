//! A store as static files behind Python's web server: robots fetch from it as from `serve`.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

use slag_tests::*;

#[test]
fn robots_fetch_from_static_files() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| dir.path().join(name);
    let (room, store, site) = (at("room"), at("store"), at("site"));
    run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", "3"]));
    let encode = |flags: &[&str]| {
        run(encode_room(&room, &store).args(["--models", "colours", "--device", "cpu"]).args(flags));
    };
    let export =
        || run_json(&mut encoder(&["store", "export", "--store", text(&store), "--out", text(&site)]));
    encode(&[]);
    let n_shards = content(&store).into_iter().map(|(_, hash)| hash).collect::<BTreeSet<_>>().len();
    assert_eq!(export()["n_objects"], n_shards);
    assert_eq!(export()["n_objects"], 0, "a second export has nothing to write");

    let mut python = Command::new("python3");
    python.args(["-u", "-m", "http.server", "0", "--bind", "127.0.0.1", "--directory", text(&site)]);
    let mut server = python.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("Python starts");
    let mut line = String::new();
    BufReader::new(server.stdout.take().expect("piped")).read_line(&mut line).expect("text");
    let url = line.split(['(', ')']).nth(1).expect("an address").to_owned();
    let fetch = |cache: &str, from: &str| {
        let cache = at(cache);
        let args =
            ["fetch", "--trust-first", "--from", from, "--at", "3.5,2.7,0", "--radius", "50", "--cache"];
        let report = run_json(edge(&args).arg(&cache));
        let answers = run_json(&mut edge(&[
            "query",
            "blue",
            "--models",
            "colours",
            "--threshold",
            "0.05",
            "--cache",
            text(&cache),
        ]));
        (report["downloaded"].clone(), answers["generation"].clone(), answers["answers"].clone())
    };
    let service = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    let first = fetch("static", &url);
    assert_eq!(first, fetch("served", &service.url));
    assert!(first.0["n_shards"].as_u64() > Some(0) && first.1 == 1, "{first:?}");

    // The next generation, and the one after it, when the first one's shards go.
    encode(&["--compact-error", "0.4"]);
    assert_eq!(export()["n_removed"], 0);
    assert_eq!(fetch("static", &url), fetch("served", &service.url));
    encode(&["--compact-error", "0.2"]);
    let exported = export();
    assert!(exported["n_removed"].as_u64().expect("a number") > 0, "{exported}");
    let third = fetch("static", &url);
    assert!(third.1 == 3 && third == fetch("served", &service.url), "{third:?}");
    server.kill().expect("killed");
    server.wait().expect("waits");
}
