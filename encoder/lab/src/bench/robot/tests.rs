use std::path::Path;

use super::report::{EngineFigures, SearchFigures};
use super::truth::Truth;
use super::*;
use crate::bench::machine::Machine;

#[test]
fn engines_have_names_and_most_gaussians() {
    let read = |text: &str| text.parse::<Engine>();
    let graph = read("qdrant-hnsw=1000000").expect("well-formed");
    assert_eq!((graph.name.as_str(), graph.most_gaussians), ("qdrant-hnsw", Some(1_000_000)));
    assert_eq!(graph.profile(), None);
    assert!(read("balanced").expect("well-formed").profile().is_some());
    for wrong in ["", "=1", "a=", "a=b", "a b", "../a"] {
        assert!(read(wrong).is_err(), "{wrong:?}");
    }
}

/// By hand: scores 1, 0.5, 0.5, 0 and -1; the second and third are ties.
#[test]
fn recall_counts_ties_and_each_id_once() {
    let dir = tempfile::tempdir().expect("a folder");
    let write = |name: &str, values: &[f32]| {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        fs_err::write(dir.path().join(name), bytes).expect("writes");
    };
    write("vectors.f32", &[0.5, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.5, 0.8]);
    write("queries.f32", &[1.0, 0.0, 0.0, 1.0]);
    let truth = Truth::read(dir.path(), 2, 1).expect("reads");
    let recall = |limit, found: &[u32]| truth.recall(0, limit, found).expect("a query");
    assert_eq!(recall(1, &[2]), 1.0);
    assert_eq!(recall(2, &[2, 4]), 1.0);
    assert_eq!(recall(2, &[2, 0]), 1.0);
    assert_eq!(recall(3, &[2, 4, 3]), 2.0 / 3.0);
    assert_eq!(recall(3, &[2, 2, 2]), 1.0 / 3.0);
    assert_eq!(recall(9, &[0, 1, 2, 3, 4]), 1.0);
    assert_eq!(recall(2, &[77]), 0.0);
    assert_eq!(truth.recall(1, 2, &[0]), None, "one query was read");
}

#[test]
fn pages_have_every_engine_and_what_was_not_run() {
    let search = |limit, recall| SearchFigures {
        limit,
        n_runs: 20,
        min_ms: 0.5,
        median_ms: 12.3,
        p99_ms: 200.0,
        recall,
    };
    let figures = |engine: &str, n_gaussians, build_secs| EngineFigures {
        engine: engine.into(),
        library: "lib 1".into(),
        n_gaussians,
        build_secs,
        disk_bytes: Some(52_000_000),
        rss_bytes: None,
        load_1min: Some(1.5),
        searches: vec![search(1_000, Some(0.9)), search(100_000, Some(1.0))],
    };
    let report = RobotReport {
        machine: Machine::here(),
        dim: 512,
        sizes: vec![1_000_000, 8_000_000],
        limits: vec![1_000, 100_000],
        texts: Vec::new(),
        figures: vec![
            figures("compact", 1_000_000, None),
            figures("qdrant-hnsw", 1_000_000, Some(61.0)),
            figures("compact", 8_000_000, None),
        ],
        not_run: vec!["qdrant-hnsw at 8 M: needs 37.7 GB".into()],
    };
    let page = report.to_string();
    for line in [
        "| **compact** (lib 1) | 1 M | 8 M |",
        "| 100,000 results, ms: median (least) | 12.3 (0.50) | 12.3 (0.50) |",
        "| 1,000 results, ms: median (least) | 12.3 (0.50) | not run |",
        "| recall, least and largest of these rows | 0.900, 1.000 | not run |",
        "| disk, GB | 0.05 | 0.05 |",
        "| building the index, s | 61 | not run |",
        "- qdrant-hnsw at 8 M: needs 37.7 GB",
        "| 100,000 | 0.52 | 0.74 | 1.36 | 2.37 |",
    ] {
        assert!(page.contains(line), "{line}\n{page}");
    }
    assert_eq!(page.matches("building the index").count(), 1, "shards are not built from vectors\n{page}");
}

/// Scripts print what the programs print. What an earlier run measured is not measured again, and an engine without its
/// program or memory is named.
#[cfg(unix)]
#[test]
fn what_cannot_run_is_named() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().expect("a folder");
    let program = dir.path().join("program");
    let script =
        "#!/bin/sh\necho '{\"model\":\"m\",\"texts\":[{\"text\":\"t\",\"times\":{\"median_ms\":9.5}}]}'\n";
    fs_err::write(&program, script).expect("writes");
    fs_err::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).expect("sets");
    let settings = RobotSettings {
        sizes: vec![1000, 2000],
        dim: 16,
        limits: vec![10],
        engines: vec!["dense".parse().expect("an engine"), "qdrant-scan=1000".parse().expect("an engine")],
        n_runs: 2,
        free_memory_bytes: Some(100_000),
        out: dir.path().join("out"),
        encoder: program.clone(),
        edge: program.clone(),
        rivals: Some(program),
        models: Vec::new(),
    };
    let figures = |name: &str| settings.out.join("figures").join(name);
    fs_err::create_dir_all(figures("")).expect("makes");
    let kept = r#"{"engine":"dense","library":"l","n_gaussians":1000,"build_secs":1.0,"disk_bytes":null,
        "rss_bytes":5,"load_1min":null,"searches":[]}"#;
    fs_err::write(figures("dense-1000-16.json"), kept).expect("writes");
    let report = run(&settings, &slag_encoder::progress::Silent).expect("runs");
    assert_eq!(report.figures.len(), 1);
    assert_eq!(report.texts[0].median_ms, 9.5);
    let named = |line: &str| report.not_run.iter().any(|reason| reason.contains(line));
    assert!(
        named("dense at 0.002 M: needs") && named("qdrant-scan at 0.001 M: needs"),
        "{:?}",
        report.not_run
    );
    assert!(named("qdrant-scan at 0.002 M: asked for up to 1000"), "{:?}", report.not_run);
    let page = fs_err::read_to_string(Path::new(&settings.out).join("robot.md")).expect("a page");
    assert!(page.contains("Not run:") && page.contains("9.50 ms"), "{page}");
}
