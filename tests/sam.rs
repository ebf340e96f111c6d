//! Encodes with SAM: a tiny model with random weights, so its masks mean nothing; the code path is the real one.

use super::*;

use slag_common::poses;
use slag_tests::*;

/// Damaged photos are omitted and named; the store does not depend on threads; a model directory of another kind is
/// refused in one message.
#[needs_shared]
fn sam_finds_masks_the_same_for_any_number_of_threads() {
    let (house, _) = (shared("scenes/house_a"), shared("models/sam_tiny"));
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (scene, views) = (house.join("point_cloud.ply"), house.join("sparse/0"));
    let images = dir.path().join("images");
    copy_dir(&house.join("images"), &images);
    // The first of three views is always used.
    let first = &poses::read(&views, Some(&images)).expect("poses").views[0];
    let photo = fs_err::read(&first.image_path).expect("reads");
    fs_err::remove_file(&first.image_path).expect("removes");
    fs_err::write(&first.image_path, &photo[..photo.len() / 2]).expect("writes");

    let encode = |name: &str, segmenter: &Path, more: &[&str]| {
        let store = dir.path().join(name);
        let mut command = encoder(&["encode", "--scene", text(&scene), "--views", text(&views), "--json"]);
        command.args(["--images", text(&images), "--segmenter", text(segmenter), "--store", text(&store)]);
        command.args(["--models", text(&root().join("tests/models/conse"))]);
        command.args("--views-limit 3 --view-order nth --metric --raster-width 320".split(' '));
        // Random weights give weak masks.
        command.args("--sam-predicted-iou 0 --sam-stability 0.2 --sam-stability-offset 0.05".split(' '));
        command.args("--points-per-side 4 --sam-points-per-batch 24 --sam-crop-layers 1".split(' '));
        command
            .args("--sam-min-region-px 3000 --sam-box-nms 1 --sam-crop-nms 1 --sam-mask-nms 0.7".split(' '));
        command.args(more);
        let output = command.env("SOURCE_DATE_EPOCH", "1700000000").output().expect("starts");
        let summary: Value = serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|_| panic!("no JSON: {}", String::from_utf8_lossy(&output.stderr)));
        (output.status.code(), summary, store)
    };
    let sam = root().join("tests/models/sam_tiny");
    let (code, summary, store) = encode("one", &sam, &["--threads", "1"]);
    println!("{summary:#}");
    assert_eq!(code, Some(3), "done with some inputs left out");
    assert_eq!(summary["n_views"], 2);
    assert!(summary["n_masks"].as_u64().expect("a number") > 20, "{summary}");
    assert_eq!(summary["skipped_views"][0]["view"], first.name.as_str());
    let stages: Vec<&str> = (summary["view_stages"].as_array().expect("a list").iter())
        .map(|stage| stage["stage"].as_str().expect("a name"))
        .collect();
    assert_eq!(stages, ["decode", "segment", "crop", "embed", "raster", "write"]);
    for stage in summary["view_stages"].as_array().expect("a list") {
        let share = stage["busy_share"].as_f64().expect("a number");
        assert!(share > 0.0 && share <= 1.0, "{stage}");
    }

    let (code, _, other) = encode("three", &sam, &["--threads", "3"]);
    assert_eq!(code, Some(3));
    assert!(content(&store) == content(&other), "threads show in the store");

    let (code, refusal, _) = encode("strict", &sam, &["--strict"]);
    assert_eq!(code, Some(1));
    let message = refusal["error"]["message"].as_str().expect("a message");
    assert!(message.contains(&first.name), "{message}");

    let (code, refusal, _) = encode("conse", &root().join("tests/models/conse"), &[]);
    assert_eq!(code, Some(1));
    let message = refusal["error"]["message"].as_str().expect("a message");
    assert!(message.contains("model.toml") && message.contains("unknown field"), "{message}");
}
