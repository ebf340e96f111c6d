use std::path::Path;

use slag_common::shard::Profile;

use super::measure::PAPER_SECONDS;
use super::report::pareto;
use super::*;
use crate::bench::machine::Machine;
use slag_encoder::progress::Silent;

fn figures(axis: &str, name: &str, seconds: f64, miou: f64) -> Figures {
    let text = |text: &str| text.to_owned();
    Figures {
        scene: text("room"),
        point: Point {
            axis: text(axis),
            name: text(name),
            views: text("--a \"b\""),
            lift: text(""),
            eval: text(""),
            profile: Profile::Compact,
        },
        made_by: text("test"),
        n_views: 8,
        n_masks: 100,
        coverage: Some(0.5),
        miou,
        macc: miou,
        map: None,
        auc: Some(0.75),
        localised: None,
        iou_on_views: None,
        n_unknown_words: 0,
        seconds,
        views_seconds: 1.0,
        coverage_seconds: 0.0,
        bytes_per_gaussian: 4.0,
        query_ms: None,
    }
}

/// By hand: a dearer worse point, equal points, a cheaper worse one, a dearer one of equal accuracy.
#[test]
fn no_point_beats_the_front() {
    let points = [(1.0, 0.2), (2.0, 0.5), (3.0, 0.4), (4.0, 0.6), (2.0, 0.5), (4.0, 0.5), (5.0, 0.6)];
    assert_eq!(pareto(&points), [true, true, false, true, true, false, false]);
    assert_eq!(pareto(&[]), [false; 0]);
}

#[test]
fn reports_name_every_point_and_mark_the_front() {
    let report = TradeoffReport {
        machine: Machine::here(),
        paper_seconds: PAPER_SECONDS,
        figures: vec![
            figures("views", "all", 10.0, 0.5),
            figures("views", "1/4", 3.0, 0.45),
            figures("width", "160 px", 9.0, 0.4),
        ],
        left_out: vec!["masks / true on room: it has no gt/masks".into()],
    };
    let dir = tempfile::tempdir().expect("a folder");
    report.write(dir.path()).expect("writes");
    let read = |name: &str| fs_err::read_to_string(dir.path().join(name)).expect("reads");
    let table = read("tradeoff.txt");
    let marks: Vec<&str> = table.lines().skip(2).take(3).map(|line| line[..3].trim()).collect();
    // Bytes are equal: only the most accurate point is optimal. Without query times none is.
    assert_eq!(marks, ["sb", "s", ""]);
    assert!(table.contains("129, 309, 1328, 3026 s") && table.contains("left out: masks / true"), "{table}");
    let csv = read("tradeoff.csv");
    let widths: Vec<usize> = csv.lines().map(|line| line.split(',').count()).collect();
    assert_eq!(widths, [22; 4], "{csv}");
    assert!(csv.contains("\"--a \"\"b\"\"\""), "{csv}");
    let json: serde_json::Value = serde_json::from_str(&read("tradeoff.json")).expect("JSON");
    assert_eq!(json["figures"][1]["name"], "1/4");
    assert!(read("room-seconds.svg").contains("Pareto front") && !dir.path().join("room-query.svg").exists());
}

/// A script records its arguments and prints what the real programs print. The second point reuses the first one's
/// contributions, a second run measures nothing, and a point without masks in the scene is left out and named.
#[cfg(unix)]
#[test]
fn points_are_measured_once_and_share_contributions() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().expect("a folder");
    let scene_dir = dir.path().join("room");
    fs_err::create_dir_all(scene_dir.join("gt")).expect("makes");
    let (calls, program) = (dir.path().join("calls"), dir.path().join("program"));
    let script = r#"#!/bin/sh
echo "$@" >> CALLS
case "$2" in
encode) resumed=0; wall=7.25; views=7
    [ -d OUT/store ] && { resumed=5; wall=0.75; views=0.5; }
    mkdir -p OUT/store
    echo '{"n_views":5,"n_masks":9,"coverage_secs":0,"n_gaussians":100,"shard_bytes":{"compact":400},'
    echo "\"n_views_resumed\":$resumed,\"wall_secs\":$wall,\"views_secs\":$views}" ;;
eval) echo '{"multi_class":[{"miou":0.25,"macc":0.5}],"unknown_words":{"a":"b"}}' ;;
esac
"#;
    let script = script.replace("CALLS", &calls.display().to_string());
    let script = script.replace("OUT", &dir.path().join("out").display().to_string());
    fs_err::write(&program, script).expect("writes");
    fs_err::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).expect("sets");
    let scene = LabelledScene {
        name: "room".into(),
        dir: scene_dir.clone(),
        splat: scene_dir.join("scene.ply"),
        poses: scene_dir.join("transforms.json"),
    };
    let point = |name: &str, views: &str, lift: &str| Point {
        axis: "a".into(),
        name: name.into(),
        views: views.into(),
        lift: lift.into(),
        eval: String::new(),
        profile: Profile::Compact,
    };
    let points = vec![
        point("one", "--x 1", ""),
        point("other", "--masks {masks}", ""),
        point("two", "--x 1", "--compact-error 0.3"),
    ];
    let settings =
        TradeoffSettings { scenes: vec![scene], grid: Grid { points }, out: dir.path().join("out") };
    let programs = Programs {
        encoder: program.clone(),
        lab: program,
        edge: None,
        models: vec!["--models".into(), "m".into()],
        made_by: "t".into(),
    };
    let report = run(&settings, &programs, &Silent).expect("runs");
    let seconds: Vec<(f64, f64)> = report.figures.iter().map(|f| (f.seconds, f.views_seconds)).collect();
    assert_eq!(seconds, [(7.25, 7.0), (7.25, 7.0)], "the second point has the views' seconds of the first");
    assert_eq!(report.figures[0].bytes_per_gaussian, 4.0);
    assert_eq!(report.left_out, ["a / other on room: it has no gt/masks"]);
    let called = fs_err::read_to_string(&calls).expect("was called");
    assert_eq!(called.lines().count(), 4, "{called}");
    assert!(called.lines().all(|line| line.contains("--models m")), "{called}");
    assert!(called.contains("--keep-views") && called.contains("--compact-error 0.3"), "{called}");
    let again = run(&settings, &programs, &Silent).expect("runs");
    assert_eq!(again.figures, report.figures);
    assert_eq!(fs_err::read_to_string(&calls).expect("was called"), called, "nothing is measured twice");
    assert!(!Path::new(&settings.out.join("store")).exists());

    // The program's error message is passed on.
    fs_err::write(&programs.encoder, "#!/bin/sh\necho '{\"error\":{\"message\":\"no such thing\"}}'; exit 1")
        .expect("writes");
    let settings = TradeoffSettings { grid: Grid { points: vec![point("three", "--y", "")] }, ..settings };
    let message = run(&settings, &programs, &Silent).expect_err("it fails").to_string();
    assert!(message.contains("a / three on room") && message.contains("no such thing"), "{message}");
}
