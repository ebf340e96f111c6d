//! Views by coverage: a limit and a budget of time stop an encode early, and the next one goes on.

use std::path::Path;

use serde_json::Value;
use slag_tests::*;

fn encode(room: &Path, store: &Path, more: &[&str]) -> Value {
    let (scene, views) = (room.join("scene.ply"), room.join("transforms.json"));
    let mut command = encoder(&["encode", "--scene", text(&scene), "--views", text(&views), "--metric"]);
    command.args(["--masks", text(&room.join("gt/masks")), "--store", text(store), "--raster-width", "320"]);
    run_json(command.args(more))
}

#[test]
fn an_encode_of_some_views_goes_on_with_more() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let room = dir.path().join("room");
    run(&mut encoder(&["generate", "scene", "--out", text(&room), "--n-views", "10", "--seed", "31"]));
    let (whole, store) = (dir.path().join("whole"), dir.path().join("store"));
    let summary = encode(&room, &whole, &[]);
    assert_eq!((&summary["view_order"], &summary["coverage"]), (&"names".into(), &Value::Null));
    let expected = content(&whole);

    let counts =
        |summary: &Value| ["n_views", "n_views_resumed"].map(|name| summary[name].as_u64().expect("a count"));
    let coverage = |summary: &Value| summary["coverage"]["coverage"].as_f64().expect("a share");
    let three = encode(&room, &store, &["--views-limit", "3"]);
    assert_eq!((counts(&three), &three["view_order"]), ([3, 0], &"coverage".into()));
    let of_three = content(&store);
    let six = encode(&room, &store, &["--views-limit", "6", "--threads", "1"]);
    assert_eq!(counts(&six), [6, 3], "the first three are not done again");
    assert!(coverage(&six) > coverage(&three) && coverage(&three) > 0.3, "{three} {six}");
    assert_ne!(content(&store), of_three);
    // Fewer again: the same three, from what is there.
    let three = encode(&room, &store, &["--views-limit", "3"]);
    assert_eq!(counts(&three), [3, 3]);
    assert_eq!(content(&store), of_three, "the views that are left over do not show");
    // A budget that is over at once: what is there, and nothing more.
    let stopped = encode(&room, &store, &["--time-budget", "0.000001"]);
    assert_eq!(counts(&stopped), [6, 6]);
    // All of them: the bytes of an encode that knew no order.
    let all = encode(&room, &store, &["--view-order", "coverage"]);
    assert_eq!((counts(&all), coverage(&all)), ([10, 6], 1.0));
    assert_eq!(content(&store), expected);
    // All were used, so nothing is kept.
    assert_eq!(counts(&encode(&room, &store, &["--view-order", "nth", "--views-limit", "2"])), [2, 0]);
    // Another raster width is another job: what was published is no unfinished work.
    assert_eq!(counts(&encode(&room, &store, &["--views-limit", "2", "--min-mask-px", "300"])), [2, 0]);

    // An empty store and no time: one view, and a whole generation of it.
    let one = encode(&room, &dir.path().join("one"), &["--time-budget", "0.000001", "--threads", "1"]);
    assert_eq!(counts(&one), [1, 0]);

    // Kept sums: another palette of the same views, without the views.
    let kept = dir.path().join("kept");
    assert_eq!(counts(&encode(&room, &kept, &["--keep-views", "--compact-error", "0.3"])), [10, 0]);
    assert_eq!(counts(&encode(&room, &kept, &[])), [10, 10]);
    assert_eq!(content(&kept), expected);
}
