//! The generated room: the demo, reproducible stores, the robot's service.

use super::*;
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

/// Evaluates the embedded encoders on unseen shapes and pairs of noun and colour, for the figures of their card.
#[nightly("evaluates 30 scenes")]
fn the_embedded_encoders_tell_things() {
    let report = run_json(&mut lab(&["eval", "encoder", "--n-scenes", "30"]));
    println!("{}", report["tallies"]);
    let tally = |i: usize, what: &str| {
        let tally = &report["tallies"][i][1];
        tally[what].as_f64().expect("a number") / tally["n_crops"].as_f64().expect("a number")
    };
    // Complete objects, and held-out pairs.
    assert!(tally(0, "noun") > 0.85 && tally(0, "colour") > 0.85 && tally(0, "material") > 0.7);
    assert!(tally(1, "noun") > 0.65 && tally(1, "colour") > 0.65);
    assert!(report["found"].as_f64() > Some(0.7) && report["found_absent"].as_f64() < Some(0.01));
}

/// Shards do not depend on threads, the order of views in the poses file, or working memory.
#[test]
fn stores_are_equal_to_the_byte() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let room = dir.path().join("room");
    copy_dir(&generated(&ROOM), &room);
    let mut poses = read_json(&room.join("transforms.json"));
    let frames = poses["frames"].as_array_mut().expect("frames");
    frames.reverse();
    frames.swap(0, 4);
    fs_err::write(room.join("transforms.json"), poses.to_string()).expect("writes");
    let (store, alone) = (dir.path().join("store"), dir.path().join("alone"));
    run(encode_room(&generated(&ROOM), &alone).args(["--models", "colours", "--threads", "1"]));
    let one = content(&alone);
    assert!(one.len() > 4, "several cells and profiles");
    run(encode_room(&room, &store).args("--models colours --threads 4 --memory 96MiB".split(' ')));
    assert_eq!(content(&store), one);
}

/// Photos of other frames are published, but told and with the exit code of a misfit; so is what robots lose.
#[test]
fn photos_that_do_not_fit_and_what_robots_lose_are_told() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (room, store) = (dir.path().join("room"), dir.path().join("store"));
    copy_dir(&generated(&ROOM), &room);
    let quick = ["--models", "colours", "--profiles", "compact"];
    run(encode_quickly(&room, &store).args([
        "--models",
        "colours",
        "--profiles",
        "compact,balanced",
        "--occupancy",
    ]));
    let mut poses = read_json(&room.join("transforms.json"));
    let frames = poses["frames"].as_array_mut().expect("frames");
    let mut photos: Vec<Value> = frames.iter().map(|frame| frame["file_path"].clone()).collect();
    photos.rotate_left(1);
    frames.iter_mut().zip(photos).for_each(|(frame, photo)| frame["file_path"] = photo);
    fs_err::write(room.join("transforms.json"), poses.to_string()).expect("writes");
    let output = encode_quickly(&room, &store).args(quick).output().expect("starts");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "{said}");
    assert!(
        said.contains("look less like their photos")
            && said.contains("free places (--occupancy), balanced shards (--profiles)"),
        "{said}"
    );
}

/// Each user mistake gets a message with a remedy.
#[test]
fn mistakes_are_named() {
    let room = generated(&ROOM);
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (store, absent) = (dir.path().join("store"), dir.path().join("absent"));
    refused(encode_room(&room, &store).arg("--images").arg(&absent), "--images");
    refused(&mut encode_room(&absent, &store), "absent");
    refused(encode_room(&room, &store).arg("--report").arg(absent.join("report.html")), "report.html");
    assert!(!store.exists(), "a report that cannot be written is refused before the encode");
    let query = ["query", "red", "--store", text(&absent)];
    refused(&mut encoder(&query), "absent");
    refused(encoder(&query).arg("--models").arg(&absent), "absent");
}

/// The robot's service: answers, refusals as problem details, and a new generation without a restart.
#[test]
fn the_robots_service_answers() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (store, cache) = (dir.path().join("store"), dir.path().join("cache"));
    // As a user encodes: with the encoder's own masks and models.
    let encode = || run(&mut encode_room(&generated(&ROOM), &store));
    encode();
    let server = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    let at = ["fetch", "--trust-first", "--from", &server.url, "--at", "3.5,2.7,0", "--cache"];
    run(edge(&at).arg(&cache));
    let robot = Service::start(&mut edge(&["serve", "--cache", text(&cache)]));
    let reply = robot.get("/query?text=sofa&near=3.5,2.7,0");
    assert!(!reply["answers"].as_array().expect("answers").is_empty(), "{reply}");
    assert_eq!(reply["asked_as"], Value::Null);
    // An unknown word, in every form of question.
    let couch = robot.get("/query?text=couch&near=3.5,2.7,0");
    assert_eq!((&couch["asked_as"], &couch["answers"]), (&json!({ "couch": "sofa" }), &reply["answers"]));
    for text in ["where%20is%20the%20couch", "lamp%20near%20the%20couch"] {
        let reply = robot.get(&format!("/v1/query?text={text}"));
        assert_eq!(reply["results"][0]["asked_as"], json!({ "couch": "sofa" }), "{reply}");
    }
    let reply = robot.get("/query?text=elephant");
    assert!(reply["answers"] == json!([]) && reply["reason"]["detail"].is_string(), "{reply}");
    assert_eq!(robot.get("/status")["scene"]["generation"], 1);

    // The robot remembers its source and place.
    encode();
    run(edge(&["fetch", "--radius", "50", "--cache"]).arg(&cache));
    for _ in 0..100 {
        if robot.get("/status")["scene"]["generation"] == 2 {
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    panic!("the service did not take up the new generation");
}

/// Views without masks, a mask of one pixel, a view of nothing, and missing or damaged photos are normal input:
/// counted, named, and omitted where necessary.
#[test]
fn odd_views_are_counted_not_fatal() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (room, masks, store) = (dir.path().join("room"), dir.path().join("masks"), dir.path().join("store"));
    copy_dir(&generated(&["--n-views", "8"]), &room);
    let (views, images) = (room.join("transforms.json"), room.join("images"));
    let mut poses = read_json(&views);
    // A camera 1,000 m up that looks up sees nothing.
    poses["frames"][4]["transform_matrix"] =
        json!([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1000], [0, 0, 0, 1]]);
    fs_err::write(&views, poses.to_string()).expect("writes");
    // 0000: two masks, one of a single pixel; 0001: none; 0004: one, in a view of nothing, which does not count.
    fs_err::create_dir(&masks).expect("makes");
    let mut ids = image::GrayImage::new(640, 480);
    image::imageops::replace(&mut ids, &image::GrayImage::from_pixel(200, 200, image::Luma([7])), 200, 150);
    ids.save(masks.join("0004.png")).expect("writes");
    ids.put_pixel(5, 5, image::Luma([9]));
    ids.save(masks.join("0000.png")).expect("writes");
    // 0002 and 0005 to 0007: truncated photos; 0003: none.
    let photo = fs_err::read(images.join("0002.png")).expect("reads");
    for cut in ["0002.png", "0005.png", "0006.png", "0007.png"] {
        fs_err::write(images.join(cut), &photo[..photo.len() / 2]).expect("writes");
    }
    fs_err::remove_file(images.join("0003.png")).expect("removes");

    let encode = |flag: &str| {
        let mut command = encode_room(&room, &store);
        command.args(["--masks", text(&masks), "--min-mask-px", "1", flag]);
        command
    };
    refused(&mut encode("--strict"), "0003.png");

    let output = encode("--restart").output().expect("starts");
    assert_eq!(output.status.code(), Some(3), "done with some inputs left out");
    let summary: Value = serde_json::from_slice(&output.stdout).expect("a summary");
    for (name, expected) in [("n_views", 2), ("n_views_without_masks", 1), ("n_masks", 2)] {
        assert_eq!(summary[name], expected, "{name}");
    }
    let skipped = summary["skipped_views"].as_array().expect("a list");
    let skipped: Vec<&Value> = skipped.iter().map(|skipped| &skipped["view"]).collect();
    assert_eq!(skipped, ["0002.png", "0003.png", "0005.png", "0006.png", "0007.png", "0004.png"]);
    assert!(summary["n_without_evidence"].as_u64() < summary["n_gaussians"].as_u64());
    assert_eq!(summary["encoder_before"], Value::Null);
    let said = String::from_utf8_lossy(&output.stderr);
    // Of four, whichever come first.
    let n_named = said.matches("unexpected end of file").count();
    assert!(said.contains("1 more views are left out") && n_named == 3, "{said}");
    // Other models: robots need the new text model, and the summary names the previous encoder.
    let output = encode("--restart").args(["--models", "colours"]).output().expect("starts");
    let (again, said) = (
        serde_json::from_slice::<Value>(&output.stdout).expect("JSON"),
        String::from_utf8_lossy(&output.stderr),
    );
    assert_eq!(again["encoder_before"], "slag-embedded-1", "{said}");
    assert!(said.contains("published with ") && said.contains("started with --models colours"), "{said}");
}
