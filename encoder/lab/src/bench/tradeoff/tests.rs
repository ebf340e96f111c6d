use std::path::Path;

use slag_common::shard::Profile;

use super::paper::PAPER;
use super::prediction::{Prediction, Ratios, predictions};
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
        n_photos: 8,
        n_gaussians: 2_000_000,
        n_masks: 100,
        coverage: Some(0.5),
        miou,
        macc: miou,
        map: Some(miou / 2.0),
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
        paper: PAPER,
        ordered: vec!["views".into()],
        figures: vec![
            figures("views", "all", 10.0, 0.5),
            figures("views", "1/4", 3.0, 0.45),
            figures("width", "160 px", 9.0, 0.4),
        ],
        predictions: Vec::new(),
        left_out: vec!["masks / true on room: it has no gt/masks".into()],
    };
    let dir = tempfile::tempdir().expect("a folder");
    report.write(dir.path()).expect("writes");
    let read = |name: &str| fs_err::read_to_string(dir.path().join(name)).expect("reads");
    let table = read("tradeoff.txt");
    let marks: Vec<&str> = table.lines().skip(2).take(3).map(|line| line[..3].trim()).collect();
    // Bytes are equal: only the most accurate point is optimal. Without query times none is.
    assert_eq!(marks, ["sb", "s", ""]);
    assert!(table.contains("129, 309, 1328, 3026 s") && table.contains("not run: masks / true"), "{table}");
    let csv = read("tradeoff.csv");
    let widths: Vec<usize> = csv.lines().map(|line| line.split(',').count()).collect();
    assert_eq!(widths, [22; 4], "{csv}");
    assert!(csv.contains("\"--a \"\"b\"\"\""), "{csv}");
    let json: serde_json::Value = serde_json::from_str(&read("tradeoff.json")).expect("JSON");
    assert_eq!(json["figures"][1]["name"], "1/4");
    assert!(read("room-seconds.svg").contains("Pareto front") && !dir.path().join("room-query.svg").exists());
    let page = read("tradeoff.html");
    let is_inline = |name: &str| page.contains(read(name).trim());
    assert!(is_inline("room-seconds.svg") && is_inline("room-bytes.svg"), "{page}");
    // The note of the point that was not run, and every point with its flags, escaped.
    assert!(page.contains("not run: masks / true") && page.contains("<td>1/4</td>"), "{page}");
    assert!(page.contains("--a &quot;b&quot;") && !page.contains("<script") && !page.contains(" src=\"http"));
}

/// Oracle: for every budget, the best accuracy of all points that it pays for.
#[test]
fn the_front_is_the_best_for_every_budget() {
    let random = |n: u64| (slag_math::random::mix64(n) >> 40) as f64 / f64::from(1 << 24);
    let points: Vec<(f64, f64)> =
        // Few values, so that ties occur.
        (0..200).map(|n| ((random(2 * n) * 20.0).floor(), (random(2 * n + 1) * 20.0).floor())).collect();
    let on_front = pareto(&points);
    for (point, is_on) in points.iter().zip(&on_front) {
        let affordable = points.iter().filter(|other| other.0 <= point.0);
        let best = affordable.map(|other| other.1).fold(f64::MIN, f64::max);
        let cheapest =
            points.iter().filter(|other| other.1 >= point.1).map(|other| other.0).fold(f64::MAX, f64::min);
        assert_eq!(*is_on, best == point.1 && cheapest == point.0, "{point:?}");
    }
}

/// Means, spread and front of two scenes, worked out by hand; the second scene is harder.
#[test]
fn several_scenes_have_a_mean_and_a_front() {
    let of = |scene: &str, axis: &str, name: &str, seconds: f64, miou: f64| {
        let mut figures = figures(axis, name, seconds, miou);
        figures.scene = scene.into();
        figures.point.views = format!("--preset {name}");
        figures
    };
    let mut given = of("b", "masks", "given", 1.0, 0.9);
    given.point.views = "--masks {masks}".into();
    let mut given_a = given.clone();
    given_a.scene = "a".into();
    given_a.map = None;
    let report = TradeoffReport {
        machine: Machine::here(),
        paper: PAPER,
        ordered: Vec::new(),
        figures: vec![
            of("a", "preset", "fast", 5.0, 0.6),
            of("a", "preset", "plain", 9.0, 0.5),
            given_a,
            of("b", "preset", "fast", 7.0, 0.4),
            of("b", "preset", "plain", 9.0, 0.3),
            given,
        ],
        left_out: Vec::new(),
        predictions: Vec::new(),
    };
    let dir = tempfile::tempdir().expect("a folder");
    report.write(dir.path()).expect("writes");
    let front: serde_json::Value =
        serde_json::from_slice(&fs_err::read(dir.path().join("front.json")).expect("reads")).expect("JSON");
    let settings = front["settings"].as_array().expect("settings");
    // `plain` costs as many bytes and more seconds; given masks are no setting for every scene.
    assert_eq!(settings.len(), 1, "{front}");
    assert_eq!(settings[0]["flags"], "--preset fast");
    let near = |name: &str, expected: f64| {
        let found = settings[0][name].as_f64().expect("a number");
        assert!((found - expected).abs() < 1e-12, "{name}: {found}");
    };
    near("miou", 0.5);
    near("miou_spread", 0.02f64.sqrt());
    // One of the seconds is the views', 8 of them; the rest, 4 and 6, is for 2 million Gaussians.
    near("seconds_per_view", 0.125);
    near("seconds_per_million_gaussians", 2.5);
    let svg = fs_err::read_to_string(dir.path().join("mean-seconds.svg")).expect("reads");
    assert!(svg.contains("over 2 scenes") && svg.contains("ScanNet scene0000_00"), "{svg}");
    for label in [">16/20<", ">32/2<", ">fast<", ">given<"] {
        assert_eq!(svg.matches(label).count(), 1, "{label}");
    }
    // Presets have no order: the front is the only line.
    assert_eq!(svg.matches("<polyline").count(), 1, "{svg}");
    // The same by average precision, without the point that has none in one scene, nor the paper's mIoU.
    let svg = fs_err::read_to_string(dir.path().join("mean-seconds-ap.svg")).expect("reads");
    assert!(svg.contains("mean average precision") && svg.contains(">fast<"), "{svg}");
    assert!(!svg.contains(">given<") && !svg.contains(">16/20<"), "{svg}");
}

/// By hand. Scene a takes 0.1 s a view and 2 s a million, b 0.3 s and 4 s; each is predicted by the other's.
#[test]
fn scenes_are_predicted_from_the_others() {
    let of = |scene: &str, n_photos: u64, views: f64, rest: f64, bytes: f64| {
        let mut figures = figures("preset", "fast", views + rest, 0.5);
        (figures.scene, figures.n_photos, figures.views_seconds) = (scene.into(), n_photos, views);
        (figures.n_gaussians, figures.bytes_per_gaussian) = (1_000_000, bytes);
        figures
    };
    let mut all = vec![of("a", 10, 1.0, 2.0, 4.0), of("b", 20, 6.0, 4.0, 5.0)];
    let mut alone = of("a", 10, 1.0, 2.0, 4.0);
    alone.point.name = "slow".into();
    all.push(alone);
    let found = predictions(&all);
    assert_eq!(found.len(), 2, "a point of one scene has no other");
    // a: 10 x 0.3 + 4 = 7 s for 3 s; b: 20 x 0.1 + 2 = 4 s for 10 s.
    assert!(
        (found[0].seconds_ratio - 7.0 / 3.0).abs() < 1e-12 && (found[1].seconds_ratio - 0.4).abs() < 1e-12
    );
    assert_eq!([found[0].bytes_ratio, found[1].bytes_ratio], [1.25, 0.8]);
    let ratios = Ratios::of(found.iter().map(Prediction::seconds)).expect("some").to_string();
    assert_eq!(ratios, "predicted/measured 0.40 in the median, 0.40 to 2.33 (2 predictions)");
    assert_eq!(Ratios::of([f64::NAN].into_iter()), None);
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
    let settings = TradeoffSettings {
        scenes: vec![scene],
        grid: Grid { points, ordered: Vec::new() },
        out: dir.path().join("out"),
    };
    let programs = Programs {
        encoder: program.clone(),
        lab: program,
        edge: None,
        models: vec!["--models".into(), "m".into()],
        made_by: "t".into(),
        equipment: Equipment::default(),
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
    let settings = TradeoffSettings {
        grid: Grid { points: vec![point("three", "--y", "")], ordered: Vec::new() },
        ..settings
    };
    let message = run(&settings, &programs, &Silent).expect_err("it fails").to_string();
    assert!(message.contains("a / three on room") && message.contains("no such thing"), "{message}");
}
