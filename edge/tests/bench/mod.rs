//! `slag-edge bench query` over generated caches, and the files it writes for other engines.

mod scene;

use std::path::Path;
use std::process::Command;

use scene::SceneSpec;
use serde_json::Value;
use slag_edge::store::{EdgeCache, Snapshot};

fn bench(cache: &Path, args: &[&str]) -> Value {
    let mut command = Command::new(env!("CARGO_BIN_EXE_slag-edge"));
    let output = command.args(["bench", "query", "--cache"]).arg(cache).args(args).output().expect("runs");
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{out}{err}");
    serde_json::from_str(&out).unwrap_or_else(|e| panic!("{e}: {out}"))
}

fn floats(path: &Path) -> Vec<f32> {
    let bytes = std::fs::read(path).expect("written");
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

/// Oracle: all Gaussians decoded and multiplied with the dumped queries in float64.
#[test]
fn what_is_timed_is_what_is_sought() {
    let dir = tempfile::tempdir().expect("a folder");
    for (is_balanced, n_blocks) in [(false, 0), (true, 1)] {
        let cache = dir.path().join(format!("cache-{n_blocks}"));
        scene::write_cache(
            &cache,
            &SceneSpec {
                n_gaussians: 9_000,
                dim: 64,
                n_components: 24,
                n_subspaces: 8,
                is_balanced,
                n_objects: if is_balanced { 40 } else { 0 },
            },
        );
        let dump = dir.path().join("dump");
        let name = dump.to_str().expect("UTF-8");
        let report = bench(
            &cache,
            &["--limits", "10,500", "--runs", "4", "--dump", name, "--ids", name, "--threads", "2"],
        );
        assert_eq!(
            (&report["scene"]["n_gaussians"], &report["machine"]["n_threads"]),
            (&9_000.into(), &2.into())
        );
        let timings = report["in_process"].as_array().expect("a list");
        assert_eq!(timings.len(), 4);
        for timing in timings {
            assert!(timing["min_ms"].as_f64() <= timing["median_ms"].as_f64());
            assert!(timing["median_ms"].as_f64() <= timing["p99_ms"].as_f64());
            assert!(timing["bytes_touched"].as_u64() > Some(9_000 / 50 * 24));
            let (found, limit) = (&timing["n_found"], timing["limit"].as_u64());
            assert!(found[0].as_u64() >= limit, "{timing}");
            assert!(timing["kind"] != "best" || found[1].as_u64() == limit, "{timing}");
        }
        let objects = &report["objects"];
        assert_eq!(objects["n_objects"].as_u64(), is_balanced.then_some(40));
        assert!(objects["min_ms"].as_f64() <= objects["median_ms"].as_f64());
        assert!(objects["median_ms"].as_f64() <= objects["p99_ms"].as_f64());
        let meta: Value =
            serde_json::from_slice(&std::fs::read(dump.join("meta.json")).expect("written")).expect("JSON");
        let (n, dim) = (meta["n"].as_u64().expect("n") as usize, 64);
        assert_eq!((n, &meta["dim"], &meta["n_queries"]), (9_000 - 9_000 / 100, &64.into(), &32.into()));
        let (vectors, queries) = (floats(&dump.join("vectors.f32")), floats(&dump.join("queries.f32")));
        assert_eq!((vectors.len(), queries.len()), (n * dim, 32 * dim));
        let snapshot = Snapshot::open(&EdgeCache::open(&cache)).expect("opens");
        let mut decoded = Vec::new();
        for shard in snapshot.shards.iter().map(|shard| shard.view()) {
            for index in 0..shard.n_with_evidence() {
                let mut vector = vec![0.0; dim];
                shard.decode(index, &mut vector);
                decoded.push(vector);
            }
        }
        for (dumped, decoded) in vectors.chunks_exact(dim).zip(&decoded) {
            let length = decoded.iter().map(|v| v * v).sum::<f64>().sqrt();
            assert!(dumped.iter().zip(decoded).all(|(a, b)| (f64::from(*a) - b / length).abs() < 1e-6));
        }
        for (at, query) in queries.chunks_exact(dim).enumerate() {
            let dot = |v: &Vec<f64>| v.iter().zip(query).map(|(a, b)| a * f64::from(*b)).sum::<f64>();
            let scores: Vec<f64> = decoded.iter().map(dot).collect();
            let mut ranked = scores.clone();
            ranked.sort_by(|a, b| b.total_cmp(a));
            let profile = if is_balanced { "balanced" } else { "compact" };
            let ids = std::fs::read(dump.join(format!("{profile}-500-{at}.u32"))).expect("written");
            let ids = ids.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
            assert_eq!(ids.len(), 500);
            // Rounding may swap equally good results.
            let rounding = if is_balanced { 5e-3 } else { 5e-4 };
            for (id, best) in ids.zip(&ranked) {
                assert!((scores[id] - best).abs() < rounding, "{id}: {} {best}", scores[id]);
            }
        }
    }
}

/// `SLAG_GENERATE="DIR N compact|balanced N_OBJECTS" cargo test ... -- --ignored` generates a cache for
/// timing.
#[test]
#[ignore = "writes a large cache where SLAG_GENERATE says"]
fn generate() {
    let spec = std::env::var("SLAG_GENERATE").expect("DIR N PROFILE N_OBJECTS");
    let [dir, n, profile, objects] = spec.split(' ').collect::<Vec<_>>()[..] else { panic!("{spec}") };
    let [n_gaussians, n_objects] = [n, objects].map(|n| n.parse().expect("a number"));
    let is_balanced = profile == "balanced";
    let spec = SceneSpec { n_gaussians, dim: 512, n_components: 96, n_subspaces: 32, is_balanced, n_objects };
    scene::write_cache(Path::new(dir), &spec);
}
