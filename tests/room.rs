//! The generated room: the demo as a user runs it, reproducible stores, the robot's service.

use std::path::Path;

use serde_json::Value;
use slag_tests::*;

#[test]
fn the_demo_answers_rightly() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let report = run_json(&mut lab(&["demo", "--out", text(&dir.path().join("demo"))]));
    for question in report["questions"].as_array().expect("questions") {
        println!("{question}");
        assert_eq!(question["right"], true);
    }
}

/// Evaluates the embedded encoders on shapes, and pairs of noun and colour, that they never saw. Their card has all
/// figures, by the same command.
#[test]
fn the_embedded_encoders_tell_things() {
    let report = run_json(&mut lab(&["eval", "encoder", "--n-scenes", "30"]));
    println!("{}", report["tallies"]);
    let tally = |i: usize, what: &str| {
        let tally = &report["tallies"][i][1];
        tally[what].as_f64().expect("a number") / tally["n_crops"].as_f64().expect("a number")
    };
    // Whole things, and held-out pairs.
    assert!(tally(0, "noun") > 0.85 && tally(0, "colour") > 0.85 && tally(0, "material") > 0.7);
    assert!(tally(1, "noun") > 0.65 && tally(1, "colour") > 0.65);
    assert!(report["found"].as_f64() > Some(0.7) && report["found_absent"].as_f64() < Some(0.01));
}

fn generate(dir: &Path, n_views: &str) -> (std::path::PathBuf, std::path::PathBuf) {
    let room = dir.join("room");
    run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", n_views]));
    (room.join("scene.ply"), room.join("transforms.json"))
}

/// Shards do not depend on threads, the order of views in the poses file, or working memory.
#[test]
fn stores_are_equal_to_the_byte() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (scene, views) = generate(dir.path(), "8");
    let mut poses: Value = serde_json::from_slice(&fs_err::read(&views).expect("reads")).expect("JSON");
    poses["frames"].as_array_mut().expect("frames").reverse();
    poses["frames"].as_array_mut().expect("frames").swap(0, 4);
    let shuffled = views.with_file_name("shuffled.json");
    fs_err::write(&shuffled, poses.to_string()).expect("writes");
    let encode = |name: &str, views: &Path, threads: &str, memory: &str| {
        let store = dir.path().join(name);
        run(&mut encoder(&[
            "encode",
            "--scene",
            text(&scene),
            "--views",
            text(views),
            "--threads",
            threads,
            "--memory",
            memory,
            "--cell-gaussians",
            "20000",
            "--store",
            text(&store),
        ]));
        content(&store)
    };
    let one = encode("one", &views, "1", "2GiB");
    assert!(one.len() > 4, "several cells and profiles");
    assert_eq!(encode("two", &views, "2", "2GiB"), one);
    assert_eq!(encode("shuffled", &shuffled, "4", "96MiB"), one);
}

/// Each mistake of a user gets a message that says what to do.
#[test]
fn mistakes_are_named() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (scene, views) = generate(dir.path(), "1");
    let store = dir.path().join("store");
    let fails = |args: &[&str]| {
        let output = encoder(args).output().expect("starts");
        assert!(!output.status.success());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let absent = dir.path().join("absent");
    let encode = |views: &str, images: &str| {
        fails(&[
            "encode",
            "--scene",
            text(&scene),
            "--views",
            views,
            "--images",
            images,
            "--store",
            text(&store),
        ])
    };
    assert!(encode(text(&views), text(&absent)).contains("--images"));
    assert!(encode(text(&absent), text(dir.path())).contains("absent"));
    assert!(fails(&["query", "red", "--store", text(&absent)]).contains("absent"));
    assert!(fails(&["query", "red", "--store", text(&absent), "--models", text(&absent)]).contains("absent"));
}

/// The robot's service: answers, refusals as problem details, and a new generation without a restart.
#[test]
fn the_robots_service_answers() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (scene, views) = generate(dir.path(), "8");
    let (store, cache) = (dir.path().join("store"), dir.path().join("cache"));
    let encode = || {
        run(&mut encoder(&[
            "encode",
            "--scene",
            text(&scene),
            "--views",
            text(&views),
            "--metric",
            "--store",
            text(&store),
        ]));
    };
    encode();
    let server = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    run(&mut edge(&[
        "fetch",
        "--trust-first",
        "--from",
        &server.url,
        "--at",
        "3.5,2.7,0",
        "--cache",
        text(&cache),
    ]));
    let robot = Service::start(&mut edge(&["serve", "--cache", text(&cache)]));
    let reply = robot.get("/query?text=sofa&near=3.5,2.7,0");
    assert!(!reply["answers"].as_array().expect("answers").is_empty(), "{reply}");
    let reply = robot.get("/query?text=elephant");
    assert!(
        reply["answers"].as_array().expect("answers").is_empty() && reply["reason"]["detail"].is_string(),
        "{reply}"
    );
    assert_eq!(robot.get("/status")["scene"]["generation"], 1);

    // The robot remembers its source and place.
    encode();
    run(&mut edge(&["fetch", "--radius", "50", "--cache", text(&cache)]));
    for _ in 0..100 {
        if robot.get("/status")["scene"]["generation"] == 2 {
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    panic!("the service did not take up the new generation");
}

/// Views without masks, a mask of one pixel, a view that sees nothing, and missing or damaged photos are normal input: they
/// are counted and named, and left out where necessary.
#[test]
fn odd_views_are_counted_not_fatal() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (scene, views) = generate(dir.path(), "5");
    let images = views.with_file_name("images");
    let mut poses: Value = serde_json::from_slice(&fs_err::read(&views).expect("reads")).expect("JSON");
    let frames = poses["frames"].as_array_mut().expect("frames");
    // A camera 1,000 m up that looks up: nothing is in view.
    frames[4]["transform_matrix"] =
        serde_json::json!([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1000], [0, 0, 0, 1]]);
    fs_err::write(&views, poses.to_string()).expect("writes");
    // 0000: two masks, one of them a single pixel; 0001: none; 0004: one, of a view that sees nothing.
    let masks = dir.path().join("masks");
    fs_err::create_dir(&masks).expect("makes");
    let mut ids = image::GrayImage::new(640, 480);
    image::imageops::replace(&mut ids, &image::GrayImage::from_pixel(200, 200, image::Luma([7])), 200, 150);
    ids.save(masks.join("0004.png")).expect("writes");
    ids.put_pixel(5, 5, image::Luma([9]));
    ids.save(masks.join("0000.png")).expect("writes");
    // 0002: a cut photo; 0003: no photo.
    let photo = fs_err::read(images.join("0002.png")).expect("reads");
    fs_err::write(images.join("0002.png"), &photo[..photo.len() / 2]).expect("writes");
    fs_err::remove_file(images.join("0003.png")).expect("removes");

    let store = dir.path().join("store");
    let encode = |strict: &[&str]| {
        let (scene, views) = (text(&scene), text(&views));
        let inputs = ["encode", "--scene", scene, "--views", views, "--masks", text(&masks), "--json"];
        encoder(&inputs)
            .args(["--min-mask-px", "1", "--store", text(&store)])
            .args(strict)
            .output()
            .expect("starts")
    };
    let output = encode(&["--strict"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stdout).contains("0003.png"));

    let output = encode(&["--restart"]);
    assert_eq!(output.status.code(), Some(3), "done with some inputs left out");
    let summary: Value = serde_json::from_slice(&output.stdout).expect("a summary");
    assert_eq!(summary["n_views"], 3);
    assert_eq!(summary["n_views_without_masks"], 1);
    assert_eq!(summary["n_masks"], 3);
    let skipped: Vec<&str> = summary["skipped_views"]
        .as_array()
        .expect("a list")
        .iter()
        .map(|s| s["view"].as_str().expect("a name"))
        .collect();
    assert_eq!(skipped, ["0002.png", "0003.png"]);
    assert!(summary["n_without_evidence"].as_u64() < summary["n_gaussians"].as_u64());
}

/// Ctrl-C ends an encode with code 130 and a state that the next one resumes, to the same shards as without.
#[cfg(unix)]
#[test]
fn an_interrupted_encode_resumes() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (scene, views) = generate(dir.path(), "10");
    let store = dir.path().join("store");
    let args = [
        "encode",
        "--scene",
        text(&scene),
        "--views",
        text(&views),
        "--threads",
        "1",
        "--store",
        text(&store),
    ];
    let mut child = encoder(&args).stderr(std::process::Stdio::null()).spawn().expect("starts");
    // Once the first view's contributions are on disk, the encode works on the others.
    let sums = store.join("job/views");
    while fs_err::read_dir(&sums).map_or(0, Iterator::count) == 0 {
        assert!(child.try_wait().expect("waits").is_none(), "ended before it could be interrupted");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    // A second encode into the same store is refused.
    let second = encoder(&args).output().expect("starts");
    assert!(String::from_utf8_lossy(&second.stderr).contains("another slag-encoder"));
    let interrupt = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(interrupt.expect("kill runs").success());
    assert_eq!(child.wait().expect("waits").code(), Some(130));
    let summary = run_json(&mut encoder(&args));
    assert!(summary["n_views_resumed"].as_u64() > Some(0), "{summary}");
    let whole = dir.path().join("whole");
    let mut args = args;
    args[args.len() - 1] = text(&whole);
    run(&mut encoder(&args));
    assert_eq!(content(&store), content(&whole));
}
