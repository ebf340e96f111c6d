//! `slag-edge bench query` over generated caches, and what it writes for other engines.

mod scene;

use std::path::Path;
use std::process::Command;

use scene::SceneSpec;
use serde_json::Value;

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

/// Oracle: all dumped vectors multiplied with the dumped queries in float64, and sorted.
#[test]
fn what_is_timed_is_what_is_sought() {
    let dir = tempfile::tempdir().expect("a folder");
    for (is_balanced, n_blocks) in [(false, 0), (true, 1)] {
        let cache = dir.path().join(format!("cache-{n_blocks}"));
        scene::write_cache(
            &cache,
            &SceneSpec { n_gaussians: 9_000, dim: 64, n_components: 24, n_groups: 8, is_balanced },
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
        let meta: Value =
            serde_json::from_slice(&std::fs::read(dump.join("meta.json")).expect("written")).expect("JSON");
        let (n, dim) = (meta["n"].as_u64().expect("n") as usize, 64);
        assert_eq!((n, &meta["dim"], &meta["n_queries"]), (9_000 - 9_000 / 100, &64.into(), &32.into()));
        let (vectors, queries) = (floats(&dump.join("vectors.f32")), floats(&dump.join("queries.f32")));
        assert_eq!((vectors.len(), queries.len()), (n * dim, 32 * dim));
        let mut n_common = 0;
        for (at, query) in queries.chunks_exact(dim).enumerate() {
            let dot =
                |v: &[f32]| v.iter().zip(query).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
            let mut ranked: Vec<(f64, u32)> = vectors.chunks_exact(dim).map(dot).zip(0..).collect();
            ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
            let profile = if is_balanced { "balanced" } else { "compact" };
            let ids = std::fs::read(dump.join(format!("{profile}-500-{at}.u32"))).expect("written");
            let ids: Vec<u32> =
                ids.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            assert_eq!(ids.len(), 500);
            n_common += ranked[..500].iter().filter(|(_, id)| ids.contains(id)).count();
        }
        // Dumped vectors are brought to unit length, so that ranks differ a little.
        assert!(n_common > 32 * 450, "{n_common} of 16000");
    }
}

/// `SLAG_GENERATE="DIR N compact|balanced" cargo test ... -- --ignored` leaves a cache to time.
#[test]
#[ignore = "writes a large cache where SLAG_GENERATE says"]
fn generate() {
    let spec = std::env::var("SLAG_GENERATE").expect("DIR N PROFILE");
    let [dir, n, profile] = spec.split(' ').collect::<Vec<_>>()[..] else { panic!("DIR N PROFILE: {spec}") };
    let n_gaussians = n.parse().expect("a number");
    let is_balanced = profile == "balanced";
    let spec = SceneSpec { n_gaussians, dim: 512, n_components: 96, n_groups: 32, is_balanced };
    scene::write_cache(Path::new(dir), &spec);
}
