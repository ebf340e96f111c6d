//! Made reports, judged by hand.

use super::*;

fn report(threshold: f32, ious: &[(&str, f64)]) -> LerfFigures {
    let thing = |(category, iou): &(&str, f64)| ThingFigures {
        frame: "frame_1".into(),
        category: (*category).into(),
        iou: *iou,
    };
    LerfFigures { threshold, things: ious.iter().map(thing).collect(), frames_without_view: Vec::new() }
}

fn sweep(scene: &str, reports: Vec<LerfFigures>) -> Sweep {
    Sweep { scene: scene.into(), reports }
}

/// Scene a is best at 0.2, b and c at 0.4; a must be judged at 0.4, and b at what a and c choose together.
fn three() -> Vec<Sweep> {
    vec![
        sweep(
            "a",
            vec![report(0.2, &[("cup", 0.9), ("jug", 0.5)]), report(0.4, &[("cup", 0.2), ("jug", 0.0)])],
        ),
        sweep("b", vec![report(0.2, &[("cup", 0.1)]), report(0.4, &[("cup", 0.3)])]),
        sweep("c", vec![report(0.2, &[("hat", 0.2)]), report(0.4, &[("hat", 0.6)])]),
    ]
}

#[test]
fn a_scene_does_not_choose_its_own_threshold() {
    let judged = leave_one_out(&three()).expect("the same thresholds");
    let of = |k: usize| (judged[k].threshold, judged[k].miou, judged[k].accuracy);
    // Others of a: 0.1 + 0.2 at 0.2, 0.3 + 0.6 at 0.4. Others of b: 0.7 + 0.2 against 0.1 + 0.6.
    assert_eq!(of(0), (0.4, 0.1, 0.0));
    assert_eq!(of(1), (0.2, 0.1, 0.0));
    // Others of c: 0.7 + 0.1 against 0.1 + 0.3.
    assert_eq!(of(2), (0.2, 0.2, 0.0));
    assert!(
        judged.iter().all(|judged| !judged.frozen_on.contains(&judged.scene) && judged.frozen_on.len() == 2)
    );
    let fixed = at_fixed(&three(), 0.4);
    assert_eq!((fixed["c"].miou, fixed["c"].accuracy), (0.6, 1.0));
    assert!(at_fixed(&three(), 0.3).is_empty());
    let mut uneven = three();
    uneven[1].reports.pop();
    assert!(matches!(leave_one_out(&uneven), Err(ProtocolError::Thresholds { .. })));
}

#[test]
fn dropped_words_and_frames_are_refused() {
    let sweeps = three();
    let pair = |word: &str| ("frame_1".to_owned(), word.to_owned());
    let labelled = Labelled::from([pair("cup"), pair("jug")]);
    check(&sweeps[0], &labelled).expect("all things");
    let more = Labelled::from([pair("cup"), pair("jug"), pair("spoon")]);
    let error = check(&sweeps[0], &more).expect_err("a word is dropped").to_string();
    assert!(error.contains("\"spoon\" on frame_1") && error.contains("without --words"), "{error}");
    assert!(check(&sweeps[0], &Labelled::from([pair("cup")])).is_err());
    let mut posed = sweeps[0].clone();
    posed.reports[1].frames_without_view.push("frame_9".into());
    let error = check(&posed, &labelled).expect_err("a frame is lost").to_string();
    assert!(error.contains("frame_9"), "{error}");
}

#[test]
fn the_page_has_the_papers_rows_and_ours() {
    let scenes = ["figurines", "teatime", "ramen", "waldo_kitchen"];
    let sweeps: Vec<Sweep> = scenes
        .iter()
        .zip([0.5, 0.6, 0.2, 0.3])
        .map(|(scene, iou)| sweep(scene, vec![report(0.28, &[("cup", iou)])]))
        .collect();
    let frozen = leave_one_out(&sweeps).expect("one threshold");
    let means = Means { n_classes: 19, miou: Some(0.3), macc: Some(0.4) };
    let unknown_words = BTreeMap::from([("counter".to_owned(), "unknown".to_owned())]);
    let scene = Scene { scene: "scene0000_00".into(), unknown_words };
    let report = ScannetMeans {
        filtered_means: Some(vec![Means { miou: Some(0.5), ..means.clone() }]),
        means: vec![means],
        missing_scenes: vec!["scene0062_00".into()],
        scenes: vec![scene],
    };
    let page = page(&frozen, &at_fixed(&sweeps, 0.28), &[("default".into(), report)]);
    for part in [
        "| SLAG | 48.10 | 56.12 | 24.76 | 27.55 | 39.13 |",
        "| **measured, threshold of the other scenes** | 50.00 | 60.00 | 20.00 | 30.00 | 40.00 |",
        "- ramen: threshold 0.28 frozen on figurines, teatime, waldo_kitchen; all 1 labelled things reported.",
        "| SLAG, prediction filtering | 37.54 49.99 | 37.71 50.70 | 45.46 60.08 |",
        "| **measured: default** | 30.00 40.00 | - | - |",
        "| **measured: default, prediction filtering** | 50.00 40.00 | - | - |",
        "scene0062_00",
        "never found, because the encoder does not know them: counter",
    ] {
        assert!(page.contains(part), "{part}\n{page}");
    }
    // A scene that was not evaluated leaves no mean.
    let frozen = leave_one_out(&sweeps[..3]).expect("one threshold");
    let partial = super::page(&frozen, &BTreeMap::new(), &[]);
    assert!(
        partial.contains("| 20.00 | - | - |") && partial.contains("waldo_kitchen was not evaluated"),
        "{partial}"
    );
}
