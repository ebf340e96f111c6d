//! The generated room: the demo as a user runs it, reproducible stores, the robot's service.

use std::path::Path;

use serde_json::Value;
use slag_tests::*;

#[test]
fn the_demo_answers_rightly() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let report = run_json(&mut encoder(&["demo", "--out", text(&dir.path().join("demo"))]));
    for question in report["questions"].as_array().expect("questions") {
        println!("{question}");
        assert_eq!(question["right"], true);
    }
}

fn generate(dir: &Path) -> (std::path::PathBuf, std::path::PathBuf) {
    let room = dir.join("room");
    run(&mut encoder(&["generate", "--out", text(&room), "--n-views", "16"]));
    (room.join("scene.ply"), room.join("transforms.json"))
}

/// The same shards for any number of threads, any order of views in the poses file, and any working memory.
#[test]
fn stores_are_equal_to_the_byte() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (scene, views) = generate(dir.path());
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
    assert_eq!(encode("shuffled", &shuffled, "2", "64MiB"), one);
}

/// What a user does wrong is answered with what to do.
#[test]
fn mistakes_are_named() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (scene, views) = generate(dir.path());
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
    let (scene, views) = generate(dir.path());
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
    run(&mut edge(&["fetch", "--from", &server.url, "--at", "3.5,2.7,0", "--cache", text(&cache)]));
    let robot = Service::start(&mut edge(&["serve", "--cache", text(&cache)]));
    let reply = robot.get("/query?text=red&near=3.5,2.7,0");
    assert!(!reply["answers"].as_array().expect("answers").is_empty(), "{reply}");
    let reply = robot.get("/query?text=pink");
    assert!(
        reply["answers"].as_array().expect("answers").is_empty() && reply["reason"].is_string(),
        "{reply}"
    );
    assert_eq!(robot.get("/status")["generation"], 1);

    // Its source and place are remembered.
    encode();
    run(&mut edge(&["fetch", "--radius", "50", "--cache", text(&cache)]));
    for _ in 0..100 {
        if robot.get("/status")["generation"] == 2 {
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    panic!("the service did not take up the new generation");
}
