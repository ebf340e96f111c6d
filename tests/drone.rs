//! The drone survey: real photos, metric, geo-referenced.

use slag_tests::*;

/// The splat fits the photos as well as the scene's notes state (25.02 dB at 1000 px).
#[needs_shared]
fn check_confirms_the_poses() {
    let scene = shared("scenes/brighton");
    let dir = tempfile::tempdir().expect("a temporary folder");
    let mut check = encoder(&["check", "--scene", text(&scene.join("point_cloud.ply"))]);
    check.args(["--views", text(&scene.join("sparse/0")), "--out", text(dir.path())]);
    let report = run_json(check.args(["--samples", "18", "--raster-width", "1000"]));
    let psnr_db = report["mean_psnr_db"].as_f64().expect("a figure");
    println!("mean PSNR of 18 photos: {psnr_db:.2} dB");
    assert!((psnr_db - 25.02).abs() <= 0.5);
    assert_eq!(fs_err::read_dir(dir.path()).expect("pictures").count(), 18);
    assert!(report["diagnosis"].is_null());
}

/// Encodes photos with automatic masks and fetches the shards around a place in metres and in degrees.
#[needs_shared]
fn a_robot_fetches_what_lies_around_it_by_metres_or_by_degrees() {
    let (scene, _) = (shared("scenes/brighton"), shared("models/image_encoder"));
    let dir = tempfile::tempdir().expect("a temporary folder");
    let store = dir.path().join("brighton");
    let models = root().join("tests/models/conse");
    // Six photos show the road end to end; all eighteen take longer.
    let mut encode = encoder(&["encode", "--scene", text(&scene.join("point_cloud.ply"))]);
    encode.args(["--views", text(&scene.join("sparse/0")), "--masks", "auto", "--models", text(&models)]);
    let summary = run_json(encode.args(["--views-limit", "6", "--store", text(&store)]));
    println!("{summary:#}");
    let n_cells = summary["n_cells"].as_u64().expect("a count");
    let server = Service::start(&mut encoder(&["serve", "--store", text(&store)]));

    // A point on the ground near the middle, also in degrees. Oracle: an ENU library, for the origin of geo.json.
    let origin = server.get("/v1/cells?x=0&y=0&z=2&radius=30");
    let nearby = origin["cells"].as_array().expect("cells").len() as u64;
    assert!(0 < nearby && nearby < n_cells, "{nearby} of {n_cells} cells");

    let fetch = |at: [&str; 2], cache: &str| {
        let cache = dir.path().join(cache);
        let mut command = edge(&["fetch", "--trust-first", "--from", &server.url, "--radius", "30"]);
        let report = run_json(command.args(at).args(["--cache", text(&cache)]));
        println!("{report}");
        let mut shards: Vec<String> = fs_err::read_dir(cache.join("shards"))
            .expect("shards")
            .map(|entry| entry.expect("an entry").file_name().into_string().expect("a hash"))
            .collect();
        shards.sort();
        shards
    };
    let by_metres = fetch(["--at", "0,0,2"], "metres");
    assert_eq!(by_metres, fetch(["--at-geo", "46.842657,-91.994008,160.509"], "degrees"));
    assert_eq!(by_metres.len() as u64, nearby);

    let cache = dir.path().join("metres");
    let models = text(&models);
    for question in ["car", "tree", "boat"] {
        let mut ask = edge(&["query", question, "--cache", text(&cache), "--models", models]);
        let reply = run_json(ask.args(["--near", "0,0,2"]));
        println!("{question}: {reply}");
        assert!(reply["answers"].is_array());
    }
}
