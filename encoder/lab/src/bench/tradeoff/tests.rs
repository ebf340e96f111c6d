use std::path::{Path, PathBuf};

use clap::Parser;
use slag_common::shard::Profile;
use slag_encoder::cli::Cli;
use slag_encoder::progress::Silent;

use super::grid::{Point, expand};
use super::measure::Programs;
use super::report::{Figures, pareto};
use super::*;
use crate::harness::Machine;

fn scene(dir: &Path, true_masks: Option<PathBuf>) -> SceneFiles {
    let (splat, poses) = (dir.join("scene.ply"), dir.join("transforms.json"));
    SceneFiles { name: "room".into(), dir: dir.into(), splat, poses, images: None, true_masks }
}

fn point(axis: &str, name: &str, views: &str, lift: &str) -> Point {
    let [axis, name, views, lift] = [axis, name, views, lift].map(str::to_owned);
    Point { axis, name, views, lift, profile: Profile::Compact }
}

fn figures(scene: &str, point: Point, seconds: f64, miou: f64) -> Figures {
    Figures {
        scene: scene.into(),
        point,
        made_by: "test".into(),
        n_photos: 8,
        n_gaussians: 2_000_000,
        miou,
        map: Some(miou / 2.0),
        seconds,
        views_seconds: 1.0,
        coverage_seconds: 0.0,
        bytes_per_gaussian: 4.0,
    }
}

fn report(figures: Vec<Figures>) -> TradeoffReport {
    let left_out = vec!["masks / true on room: it has no gt/masks".into()];
    TradeoffReport { machine: Machine::here(), figures, left_out }
}

#[test]
fn built_in_grids_have_flags_of_encode() {
    let scene = scene(Path::new("a"), Some("m".into()));
    for name in ["quick", "full", "paper"] {
        let grid = Grid::find(Path::new(name)).expect("a grid");
        assert!(grid.points.len() >= 4);
        for point in &grid.points {
            let expand = |flags: &String| expand(flags, &scene, Some(&"s".into())).unwrap().unwrap();
            let line = "slag-encoder encode --scene a --views b --store c".split(' ').map(str::to_owned);
            let line: Vec<String> =
                line.chain([&point.views, &point.lift].into_iter().flat_map(expand)).collect();
            let parsed = Cli::try_parse_from(&line);
            assert!(parsed.is_ok(), "{line:?}: {}", parsed.err().map_or(String::new(), |e| e.to_string()));
        }
    }
}

#[test]
fn placeholders_are_the_scenes() {
    let bare = scene(Path::new("a"), None);
    let words = |flags: &str, sam: Option<&PathBuf>| expand(flags, &bare, sam).map_err(|e| e.to_string());
    assert_eq!(words("--views-limit 25%", None), Ok(Ok(vec!["--views-limit".into(), "25%".into()])));
    assert_eq!(words("--masks {masks}", None), Ok(Err("it has no gt/masks")));
    assert_eq!(words("--segmenter {sam}", None), Ok(Err("no --segmenter is given")));
    assert_eq!(words("--x {sam}", Some(&"/a b".into())), Ok(Ok(vec!["--x".into(), "/a b".into()])));
    for wrong in ["{view}", "{masks", "a{masks}"] {
        assert!(words(wrong, None).is_err_and(|message| message.contains(wrong)), "{wrong}");
    }
    for (wrong, expected) in [
        (r#"{"points": [{"axis": "a", "name": "b"}, {"axis": "a", "name": "b"}]}"#, "a / b occurs twice"),
        (r#"{"points": [{"name": "b"}]}"#, "axis"),
    ] {
        let message = format!("{:#}", Grid::parse(wrong).expect_err(wrong));
        assert!(message.contains(expected), "{message}");
    }
}

/// Oracle: for every budget, the best accuracy of all points that it pays for.
#[test]
fn the_front_is_the_best_for_every_budget() {
    let random = |n: u64| (slag_math::random::mix64(n) >> 40) as f64 / f64::from(1 << 24);
    let points: Vec<(f64, f64)> =
        // Few values, so that ties occur.
        (0..200).map(|n| ((random(2 * n) * 20.0).floor(), (random(2 * n + 1) * 20.0).floor())).collect();
    for (point, is_on) in points.iter().zip(pareto(&points)) {
        let affordable = points.iter().filter(|other| other.0 <= point.0);
        let best = affordable.map(|other| other.1).fold(f64::MIN, f64::max);
        let as_good = points.iter().filter(|other| other.1 >= point.1);
        let cheapest = as_good.map(|other| other.0).fold(f64::MAX, f64::min);
        assert_eq!(is_on, best == point.1 && cheapest == point.0, "{point:?}");
    }
}

#[test]
fn reports_name_every_point_and_mark_the_front() {
    let report = report(vec![
        figures("room", point("views", "all", "--a b", ""), 10.0, 0.5),
        figures("room", point("views", "1/4", "", ""), 3.0, 0.45),
        figures("room", point("width", "160 px", "", ""), 9.0, 0.4),
    ]);
    let dir = tempfile::tempdir().expect("a folder");
    report.write(dir.path()).expect("writes");
    let read = |name: &str| fs_err::read_to_string(dir.path().join(name)).expect("reads");
    let table = read("tradeoff.md");
    let rows = table.lines().filter(|line| line.starts_with("| room"));
    let marks: Vec<&str> = rows.map(|line| line.split('|').nth(2).expect("a cell").trim()).collect();
    // Bytes are equal: only the most accurate point is optimal.
    assert_eq!(marks, ["sb", "s", ""]);
    assert!(table.contains("not run: masks / true"), "{table}");
    let json: serde_json::Value = serde_json::from_str(&read("tradeoff.json")).expect("JSON");
    assert_eq!(json["figures"][1]["name"], "1/4");
}

/// Means and front of two scenes, worked out by hand; the second scene is harder.
#[test]
fn several_scenes_have_a_mean_and_a_front() {
    let of = |scene: &str, name: &str, seconds: f64, miou: f64| {
        figures(scene, point("preset", name, &format!("--preset {name}"), ""), seconds, miou)
    };
    let given = figures("b", point("masks", "given", "--masks {masks}", ""), 1.0, 0.9);
    let given_a = Figures { scene: "a".into(), map: None, ..given.clone() };
    let (fast, plain) = (of("a", "fast", 5.0, 0.6), of("a", "plain", 9.0, 0.5));
    let report =
        report(vec![fast, plain, given_a, of("b", "fast", 7.0, 0.4), of("b", "plain", 9.0, 0.3), given]);
    let dir = tempfile::tempdir().expect("a folder");
    report.write(dir.path()).expect("writes");
    let read = |name: &str| fs_err::read_to_string(dir.path().join(name)).expect("reads");
    let front: serde_json::Value = serde_json::from_str(&read("front.json")).expect("JSON");
    let settings = front["settings"].as_array().expect("settings");
    // `plain` costs as many bytes and more seconds; given masks are no setting for every scene.
    assert_eq!((settings.len(), &settings[0]["flags"]), (1, &"--preset fast".into()), "{front}");
    // One of the seconds is the views', 8 of them; the rest, 4 and 6, is for 2 million Gaussians.
    for (name, expected) in
        [("miou", 0.5), ("seconds_per_view", 0.125), ("seconds_per_million_gaussians", 2.5)]
    {
        let found = settings[0][name].as_f64().expect("a number");
        assert!((found - expected).abs() < 1e-12, "{name}: {found}");
    }
}

/// A script records its arguments and prints what the real programs print. The second point reuses the first one's
/// contributions, a second run measures nothing, and a point without masks in the scene is left out and named.
#[test]
fn points_are_measured_once_and_share_contributions() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().expect("a folder");
    let (calls, program, out) =
        (dir.path().join("calls"), dir.path().join("program"), dir.path().join("out"));
    let script = r#"#!/bin/sh
echo "$@" >> CALLS
case "$2" in
encode) resumed=0; wall=7.25; views=7
    [ -d OUT/store ] && { resumed=5; wall=0.75; views=0.5; }
    mkdir -p OUT/store
    echo '{"n_views":5,"n_masks":9,"coverage_secs":0,"n_gaussians":100,"shard_bytes":{"compact":400},'
    echo "\"n_views_resumed\":$resumed,\"wall_secs\":$wall,\"views_secs\":$views}" ;;
eval) echo '{"miou":0.25,"macc":0.5,"unknown_words":{"a":"b"}}' ;;
esac
"#;
    let script = script.replace("CALLS", &calls.display().to_string());
    fs_err::write(&program, script.replace("OUT", &out.display().to_string())).expect("writes");
    fs_err::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).expect("sets");
    let scenes = [scene(dir.path(), None)];
    let points = vec![
        point("a", "one", "--x 1", ""),
        point("a", "other", "--masks {masks}", ""),
        point("a", "two", "--x 1", "--compact-error 0.3"),
    ];
    let grid = Grid { points };
    let programs = Programs {
        encoder: program.clone(),
        lab: program,
        models: vec!["--models".into(), "m".into()],
        segmenter: None,
        made_by: "t".into(),
    };
    let report = measure(&scenes, &grid, &programs, &out, &Silent).expect("runs");
    let seconds: Vec<(f64, f64)> = report.figures.iter().map(|f| (f.seconds, f.views_seconds)).collect();
    assert_eq!(seconds, [(7.25, 7.0), (7.25, 7.0)], "the second point has the views' seconds of the first");
    assert_eq!(report.figures[0].bytes_per_gaussian, 4.0);
    assert_eq!(report.left_out, ["a / other on room: it has no gt/masks"]);
    let called = fs_err::read_to_string(&calls).expect("was called");
    assert_eq!(called.lines().count(), 4, "{called}");
    assert!(called.lines().all(|line| line.contains("--models m")), "{called}");
    assert!(called.contains("--keep-views") && called.contains("--compact-error 0.3"), "{called}");
    assert_eq!(measure(&scenes, &grid, &programs, &out, &Silent).expect("runs").figures, report.figures);
    assert_eq!(fs_err::read_to_string(&calls).expect("was called"), called, "nothing is measured twice");
    assert!(!out.join("store").exists());

    // The program's error message is passed on.
    fs_err::write(&programs.encoder, "#!/bin/sh\necho '{\"error\":{\"message\":\"no such thing\"}}'; exit 1")
        .expect("writes");
    let grid = Grid { points: vec![point("a", "three", "--y", "")] };
    let message = format!("{:#}", measure(&scenes, &grid, &programs, &out, &Silent).expect_err("it fails"));
    assert!(message.contains("a / three on room") && message.contains("no such thing"), "{message}");
}
