//! Views by coverage: a limit or a time budget stops an encode early; the next one continues.

use super::*;

use slag_tests::*;

const VIEWS: [&str; 4] = ["--n-views", "10", "--seed", "31"];

/// Encodes the room's scene with its true masks; returns the summary.
fn encode_scene(room: &Path, views: &Path, store: &Path, more: &[&str]) -> Value {
    let mut command = encoder(&["encode", "--scene", text(&room.join("scene.ply")), "--views", text(views)]);
    command.args(["--masks", text(&room.join("gt/masks")), "--store", text(store), "--name", "room"]);
    run_json(command.args(["--metric", "--raster-width", "320"]).args(more))
}

/// Views used, and those of them that were kept from before.
fn counts(summary: &Value) -> [u64; 2] {
    ["n_views", "n_views_resumed"].map(|name| summary[name].as_u64().expect("a count"))
}

#[test]
fn an_encode_of_some_views_goes_on_with_more() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let room = generated(&VIEWS);
    let store = dir.path().join("store");
    let encode_into = |name: &str, more: &[&str]| {
        encode_scene(&room, &room.join("transforms.json"), &dir.path().join(name), more)
    };
    let encode = |more: &[&str]| encode_into("store", more);
    let summary = encode_into("whole", &[]);
    assert_eq!((&summary["view_order"], &summary["coverage"]), (&"names".into(), &Value::Null));
    let expected = content(&dir.path().join("whole"));

    let coverage = |summary: &Value| summary["coverage"]["coverage"].as_f64().expect("a share");
    let three = encode(&["--views-limit", "3"]);
    assert_eq!((counts(&three), &three["view_order"]), ([3, 0], &"coverage".into()));
    let of_three = content(&store);
    let six = encode(&["--views-limit", "6", "--threads", "1"]);
    assert_eq!(counts(&six), [6, 3], "the first three are not done again");
    assert!(coverage(&six) > coverage(&three) && coverage(&three) > 0.3, "{three} {six}");
    assert_ne!(content(&store), of_three);
    // A lower limit: the same three, from kept contributions.
    assert_eq!(counts(&encode(&["--views-limit", "3"])), [3, 3]);
    assert_eq!(content(&store), of_three, "the views that are left over do not show");
    // A budget of no time: the kept views only.
    assert_eq!(counts(&encode(&["--time-budget", "0.000001"])), [6, 6]);
    // All views: the bytes of an encode without an order.
    let all = encode(&["--view-order", "coverage"]);
    assert_eq!((counts(&all), coverage(&all)), ([10, 6], 1.0));
    assert_eq!(content(&store), expected);
    // All views were used, so nothing is kept.
    assert_eq!(counts(&encode(&["--view-order", "nth", "--views-limit", "2"])), [2, 0]);
    // Other mask settings are another job; the published views are no unfinished work.
    assert_eq!(counts(&encode(&["--views-limit", "2", "--min-mask-px", "300"])), [2, 0]);

    // An empty store and no time: a generation of one view.
    assert_eq!(counts(&encode_into("one", &["--time-budget", "0.000001", "--threads", "1"])), [1, 0]);

    // Kept contributions: another codebook of the same views, without their photos.
    assert_eq!(counts(&encode_into("kept", &["--keep-views", "--compact-error", "0.3"])), [10, 0]);
    assert_eq!(counts(&encode_into("kept", &[])), [10, 10]);
    assert_eq!(content(&dir.path().join("kept")), expected);
}

/// The summary states the cost of views and cells; threads and resuming do not change it.
#[nightly("encodes a room three times")]
fn what_was_spent_is_reported() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let room = generated(&VIEWS);
    let encode = |name: &str, more: &[&str]| {
        let (scene, views) = (room.join("scene.ply"), room.join("transforms.json"));
        let mut command = encoder(&["encode", "--scene", text(&scene), "--views", text(&views), "--metric"]);
        command.args(["--store", text(&dir.path().join(name)), "--preset", "plain", "--mask-levels", "4"]);
        run_json(command.args(more))
    };
    let column = |summary: &Value, name: &str| {
        let column = summary["views"][name].as_array().expect("a column").iter();
        column.map(|v| v.as_f64().expect("a number")).collect::<Vec<_>>()
    };
    let narrow = ["--raster-width", "320"];
    let first = encode("first", &[&["--threads", "1", "--keep-views"][..], &narrow].concat());
    assert_eq!(column(&first, "raster_width_px"), [320.0; 10]);
    for total in ["n_masks", "n_regions", "n_entries"] {
        assert_eq!(column(&first, total).iter().sum::<f64>(), first[total].as_f64().expect("a count"));
    }
    assert!(column(&first, "secs").iter().all(|secs| *secs > 0.0));
    let cells = first["cells"].as_array().expect("cells");
    let of_cells = cells.iter().map(|cell| cell["n_entries"].as_u64().expect("a count")).sum::<u64>();
    assert_eq!(Some(of_cells), first["n_entries"].as_u64());
    for cell in cells {
        let error = |profile: &str| cell["score_error"][profile].as_f64().expect("an error");
        assert!(error("compact") < 0.2 && error("compact") > error("balanced"), "{cell}");
        assert_eq!((error("exact"), cell["n_subspaces"].as_u64() > Some(0)), (0.0, true));
    }
    let resumed = encode("first", &[&["--keep-views"][..], &narrow].concat());
    assert_eq!((&resumed["n_views_resumed"], &resumed["views"]), (&10.into(), &first["views"]));
    encode("second", &[&["--threads", "2"][..], &narrow].concat());
    assert_eq!(content(&dir.path().join("second")), content(&dir.path().join("first")));

    assert_eq!(column(&encode("by_photo", &[]), "raster_width_px"), [640.0; 10]);
}

/// Photos of a second flight are added and one is withdrawn: only new views are done, and the bytes are those of
/// an encode of all photos from scratch. Masks of the new photos lie beside the old ones.
#[test]
fn photos_are_added_and_withdrawn() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let room = dir.path().join("room");
    copy_dir(&generated(&VIEWS), &room);
    let (masks, views) = (room.join("gt/masks"), room.join("transforms.json"));
    let poses = read_json(&views);
    let name = |i: usize| poses["frames"][i]["file_path"].as_str().expect("a path").to_owned();
    let poses_of = |file: &str, frames: &[usize]| {
        let mut some = poses.clone();
        some["frames"] = frames.iter().map(|i| poses["frames"][*i].clone()).collect();
        fs_err::write(room.join(file), some.to_string()).expect("writes");
        room.join(file)
    };
    let encode = |store: &str, views: &Path, more: &[&str]| {
        let store = dir.path().join(store);
        (counts(&encode_scene(&room, views, &store, more)), content(&store))
    };
    let first = poses_of("first.json", &[0, 2, 3, 5, 6, 7]);
    let second = poses_of("second.json", &[1, 4, 8, 9]);
    // The masks of the second flight do not exist yet.
    let later: Vec<_> = files_below(&masks)
        .into_iter()
        .filter(|path| [1, 4, 8, 9].iter().any(|i| path.file_stem() == Path::new(&name(*i)).file_stem()))
        .collect();
    assert_eq!(later.len(), 4, "one for each new photo");
    let aside = dir.path().join("aside");
    fs_err::create_dir(&aside).expect("makes");
    later
        .iter()
        .for_each(|path| fs_err::rename(path, aside.join(path.file_name().expect("a name"))).expect("moves"));
    assert_eq!(encode("grown", &first, &["--keep-views"]).0, [6, 0]);
    later
        .iter()
        .for_each(|path| fs_err::rename(aside.join(path.file_name().expect("a name")), path).expect("moves"));

    let added = encode("grown", &first, &["--add", text(&second)]);
    assert_eq!(added.0, [10, 6], "only the new views are done");
    assert_eq!(added.1, encode("whole", &views, &[]).1, "all photos from the beginning");

    let without = poses_of("without.json", &[0, 1, 2, 4, 5, 6, 7, 8, 9]);
    let dropped = encode("grown", &views, &["--drop", "0003.png"]);
    assert_eq!(dropped.0, [9, 9], "nothing is done again");
    assert_eq!(dropped.1, encode("fewer", &without, &[]).1, "without the photo from the beginning");
    // A withdrawn photo leaves nothing behind, and returns as a new one.
    assert_eq!(encode("grown", &views, &["--keep-views"]).0, [10, 9]);

    // A photo replaced under its name is done again, its neighbours are not.
    fs_err::copy(room.join(name(0)), room.join(name(5))).expect("copies");
    let replaced = encode("grown", &views, &["--keep-views"]);
    assert_eq!(replaced.0, [10, 9]);
    assert_eq!(replaced.1, encode("replaced", &views, &[]).1);

    let fails = |flag: &str, value: &str, expected: &str| {
        let mut command =
            encoder(&["encode", "--scene", text(&room.join("scene.ply")), "--views", text(&views)]);
        refused(command.args(["--store", text(&dir.path().join("grown")), flag, value]), expected);
    };
    fails("--add", text(&second), "has a pose already");
    fails("--drop", "absent.png", "absent.png");

    // The splat was retrained: its Gaussians in reverse, a hundred removed and fifty moved by a bit.
    let scene = room.join("scene.ply");
    let ply = fs_err::read(&scene).expect("reads");
    let end = b"end_header\n";
    let head = ply.windows(end.len()).position(|part| part == end).expect("a header") + end.len();
    let header = String::from_utf8_lossy(&ply[..head]);
    let count = header.lines().find_map(|line| line.strip_prefix("element vertex ")).expect("a count");
    let n: usize = count.parse().expect("a number");
    let mut changed = header.replace(&format!("vertex {n}\n"), &format!("vertex {}\n", n - 100)).into_bytes();
    let rows = ply[head..].chunks((ply.len() - head) / n).rev().skip(100);
    for (i, gaussian) in rows.enumerate() {
        // The lowest byte of its x, the first property.
        changed.push(gaussian[0] ^ u8::from(i < 50));
        changed.extend(&gaussian[1..]);
    }
    fs_err::write(&scene, changed).expect("writes");
    let again = ["--keep-views", "--views-limit", "2"];
    let summary = || encode_scene(&room, &views, &dir.path().join("grown"), &again);
    let retrained = summary();
    assert_eq!(retrained["n_views_resumed"], 0);
    let lost = &retrained["lost_views"];
    assert_eq!(lost["n_views"], 10);
    assert!(lost["reason"].as_str().expect("text").contains("no view is taken"), "{lost}");
    assert_eq!(summary()["lost_views"], Value::Null);
}

/// A view with the scene behind it shows nothing of it, and names may be as long as the disk takes.
#[test]
fn drawings_that_show_nothing_are_told() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let room = generated(&VIEWS);
    let poses = dir.path().join("transforms.json");
    let draw = |is_seen: bool| {
        let mut json = read_json(&room.join("transforms.json"));
        let frames = json["frames"].as_array_mut().expect("frames");
        frames.truncate(2);
        frames[0]["file_path"] = format!("{}.png", "a".repeat(250)).into();
        for frame in &mut frames[usize::from(is_seen)..] {
            // Far ahead of where it looks from; OpenGL cameras look along -z.
            for row in 0..3 {
                let row = &mut frame["transform_matrix"][row];
                let [back, at] = [2, 3].map(|column: usize| row[column].as_f64().expect("a number"));
                row[3] = (at - 1e3 * back).into();
            }
        }
        fs_err::write(&poses, json.to_string()).expect("written");
        let mut draw = encoder(&["draw", "-q", "--depth", "--scene", text(&room.join("scene.ply"))]);
        draw.args(["--views", text(&poses), "--out", text(&dir.path().join("drawn"))]).output().expect("runs")
    };
    let [some, none] = [draw(true), draw(false)];
    let said = String::from_utf8_lossy(&some.stderr);
    assert!(some.status.code() == Some(3) && said.contains("1 of 2 views show nothing"), "{said}");
    let said = String::from_utf8_lossy(&none.stderr);
    assert!(none.status.code() == Some(1) && said.contains("none of the 2 views shows anything"), "{said}");
    assert_eq!(files_below(&dir.path().join("drawn/depth")).len(), 2);
}
