//! A store as static files behind Python's web server: robots fetch from it as from `serve`.

use super::*;

use slag_tests::*;

#[test]
fn robots_fetch_from_static_files() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| dir.path().join(name);
    let (store, site) = (at("store"), at("site"));
    encoded_into(&store, &ROOM, &SITE);
    let encode = |error: &str| {
        run(encode_quickly(&generated(&ROOM), &store).args(SITE).args(["--compact-error", error]));
    };
    let export =
        || run_json(&mut encoder(&["store", "export", "--store", text(&store), "--out", text(&site)]));
    let n_shards = content(&store).into_iter().map(|(_, hash)| hash).collect::<BTreeSet<_>>().len();
    assert_eq!(export()["n_files"], n_shards);
    assert_eq!(export()["n_files"], 0, "a second export has nothing to write");
    let object = std::fs::read_dir(site.join("v1/objects")).unwrap().next().unwrap().unwrap();
    let mut bytes = std::fs::read(object.path()).expect("read");
    bytes[7] ^= 1;
    std::fs::write(object.path(), bytes).expect("written");
    assert_eq!(export()["n_files"], 1, "what was damaged is written again");

    let files = Service::of_files(&site);
    let fetch = |cache: &str, from: &str| {
        let cache = at(cache);
        let report = run_json(&mut fetch(from, &cache));
        let all = ["--kind", "gaussians", "--threshold=-1", "--limit", "5", "--cache", text(&cache)];
        let answers = run_json(edge(&["query", "blue", "--models", "colours"]).args(all));
        assert_eq!(answers["answers"].as_array().map(Vec::len), Some(5), "{answers}");
        (report["downloaded"].clone(), answers["generation"].clone(), answers["answers"].clone())
    };
    let service = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    let first = fetch("static", &files.url);
    assert_eq!(first, fetch("served", &service.url));
    assert!(first.0["n_shards"].as_u64() > Some(0) && first.1 == 1, "{first:?}");

    // The next generation, and then the one that drops the first one's shards.
    encode("0.4");
    assert_eq!(export()["n_removed"], 0);
    assert_eq!(fetch("static", &files.url), fetch("served", &service.url));
    encode("0.2");
    let exported = export();
    assert!(exported["n_removed"].as_u64().expect("a number") > 0, "{exported}");
    let third = fetch("static", &files.url);
    assert!(third.1 == 3 && third == fetch("served", &service.url), "{third:?}");
}
