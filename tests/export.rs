//! A store as static files behind Python's web server: robots fetch from it as from `serve`.

use std::collections::BTreeSet;
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
    assert_eq!(export()["n_files"], n_shards);
    assert_eq!(export()["n_files"], 0, "a second export has nothing to write");

    let mut python = Command::new("python3");
    python.args(["-u", "-m", "http.server", "0", "--bind", "127.0.0.1", "--directory", text(&site)]);
    let files = Service::start_as(python.stderr(Stdio::null()));
    let fetch = |cache: &str, from: &str| {
        let cache = at(cache);
        let args =
            ["fetch", "--trust-first", "--from", from, "--at", "3.5,2.7,0", "--radius", "50", "--cache"];
        let report = run_json(edge(&args).arg(&cache));
        let all = ["--kind", "gaussians", "--threshold=-1", "--limit", "5", "--cache", text(&cache)];
        let answers = run_json(edge(&["query", "blue", "--models", "colours"]).args(all));
        assert_eq!(answers["answers"].as_array().map(Vec::len), Some(5), "{answers}");
        (report["downloaded"].clone(), answers["generation"].clone(), answers["answers"].clone())
    };
    let service = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    let first = fetch("static", &files.url);
    assert_eq!(first, fetch("served", &service.url));
    assert!(first.0["n_shards"].as_u64() > Some(0) && first.1 == 1, "{first:?}");

    // The next generation, and the one after it, when the first one's shards go.
    encode(&["--compact-error", "0.4"]);
    assert_eq!(export()["n_removed"], 0);
    assert_eq!(fetch("static", &files.url), fetch("served", &service.url));
    encode(&["--compact-error", "0.2"]);
    let exported = export();
    assert!(exported["n_removed"].as_u64().expect("a number") > 0, "{exported}");
    let third = fetch("static", &files.url);
    assert!(third.1 == 3 && third == fetch("served", &service.url), "{third:?}");
}
