//! The Gaussians of an answer are those of the input splat: on the robot, on the encoder, over HTTP, in a picture.

use super::*;

use slag_common::Gaussians;
use slag_common::splat::ply;
use slag_tests::*;

/// World units; far below the distance between most neighbours.
const POSITION_ERROR: &str = "0.0004";

/// Encodes the room with input indices in fine positions; returns its Gaussians.
fn encoded(store: &Path, profiles: &str) -> Gaussians {
    let flags = ["--input-indices", "--position-error", POSITION_ERROR, "--profiles", profiles];
    run(encode_quickly(&generated(&ROOM), store).args(["--models", "colours"]).args(flags));
    splat::read(&generated(&ROOM).join("scene.ply"), &ReadOptions { with_sh_rest: true }).expect("reads")
}

/// Asserts that each point's input index is that of the splat's nearest Gaussian, by brute force, or of one as
/// near within the position error. Returns the indices.
fn assert_nearest(points: &[[f64; 4]], scene: &Gaussians) -> Vec<u32> {
    let error = 1.01 * POSITION_ERROR.parse::<f64>().expect("a number");
    let mut n_ambiguous = 0;
    let mut indices = Vec::new();
    for [x, y, z, index] in points {
        let place = DVec3::new(*x, *y, *z);
        let distances = scene.means_in_world.iter().map(|mean| (*mean - place).abs().max_element());
        let near: Vec<u32> = (0..).zip(distances).filter(|(_, d)| *d <= error).map(|(i, _)| i).collect();
        assert!(near.contains(&(*index as u32)), "{index} at {place} is not among {near:?}");
        n_ambiguous += usize::from(near.len() > 1);
        indices.push(*index as u32);
    }
    assert!(!points.is_empty() && n_ambiguous * 20 <= points.len(), "{n_ambiguous} of {}", points.len());
    let n_points = indices.len();
    indices.sort_unstable();
    indices.dedup();
    assert_eq!(indices.len(), n_points, "a Gaussian is listed once");
    indices
}

fn read_points(path: &Path) -> Vec<[f64; 4]> {
    ply::read_vertices(path, ["x", "y", "z", "input_index"]).expect("a PLY of points")
}

#[test]
fn a_robots_answer_names_gaussians_of_the_input() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let store = dir.path().join("store");
    let scene = encoded(&store, "compact,balanced");
    let server = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    for profile in ["compact", "balanced"] {
        let cache = dir.path().join(profile);
        run(fetch(&server.url, &cache).args(["--profile", profile]));
        for kind in ["objects", "clusters", "gaussians"] {
            let file = dir.path().join(format!("{profile}-{kind}.ply"));
            let query = ["query", "red", "--models", "colours", "--kind", kind, "--limit", "200"];
            let reply = run_json(edge(&query).args(["--cache", text(&cache), "--ply", text(&file)]));
            let answers = reply["answers"].as_array().expect("answers");
            let points = read_points(&file);
            let expected: u64 = match kind {
                "gaussians" => answers.len() as u64,
                _ => answers.iter().map(|answer| answer["n_gaussians"].as_u64().expect("a number")).sum(),
            };
            assert_eq!(points.len() as u64, expected, "{profile} {kind}");
            assert_nearest(&points, &scene);
        }
        let robot = Service::start(&mut edge(&["serve", "--models", "colours", "--cache", text(&cache)]));
        let url = format!("{}/query?text=red&kind=gaussians&limit=200&format=ply", robot.url);
        let body = ureq::get(url).call().expect("answers").body_mut().read_to_vec().expect("bytes");
        let file = dir.path().join(format!("{profile}-gaussians.ply"));
        assert!(fs_err::read(file).expect("reads") == body, "HTTP and command line give the same file");
    }
}

#[test]
fn an_answer_on_the_encoder_is_a_splat() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (store, room) = (dir.path().join("store"), generated(&ROOM));
    let scene = encoded(&store, "compact");
    let files = ["points.ply", "splat.ply", "scores.npy"].map(|name| dir.path().join(name));
    let [points, found, scores] = &files;
    let query = ["query", "red", "--store", text(&store), "--models", "colours", "--threshold", "0.4"];
    let without_scene = run_json(encoder(&query).args(["--ply", text(points), "--scores", text(scores)]));
    let scene_file = room.join("scene.ply");
    let mut with_scene = encoder(&query);
    with_scene.args(["--scene", text(&scene_file), "--ply", text(found)]);
    assert_eq!(run_json(&mut with_scene), without_scene);

    let indices = assert_nearest(&read_points(points), &scene);
    let scores = read_npy::<f32>(scores);
    let expected: Vec<u32> = (0..scene.len() as u32).filter(|i| scores[*i as usize] >= 0.4).collect();
    assert_eq!(indices, expected);
    assert_eq!(without_scene["n_matching"], expected.len());

    // The splat has the same Gaussians with all their parameters, best first.
    let found = splat::read(found, &ReadOptions { with_sh_rest: true }).expect("a splat");
    let mut best_first = expected;
    best_first.sort_by(|a, b| scores[*b as usize].total_cmp(&scores[*a as usize]).then(a.cmp(b)));
    assert_eq!(found.len(), best_first.len());
    for (at, index) in best_first.iter().map(|index| *index as usize).enumerate() {
        assert_eq!(found.means_in_world[at], scene.means_in_world[index]);
        assert_eq!(found.sh_dc[at], scene.sh_dc[index]);
        assert!((found.opacities[at] - scene.opacities[index]).abs() < 1e-5);
        assert!((0..3).all(|c| (found.scales[at][c] / scene.scales[index][c] - 1.0).abs() < 1e-5));
    }

    // The splat in another frame, as nerfstudio exports it.
    let mut moved = scene.clone();
    moved
        .means_in_world
        .iter_mut()
        .for_each(|mean| *mean = DVec3::new(0.2 * mean.y - 1.0, -0.2 * mean.x, 0.2 * mean.z));
    let other = dir.path().join("moved.ply");
    ply::write(&other, &moved).expect("writes");
    run_json(encoder(&query).args(["--scene", text(&other), "--ply", text(&files[1])]));
    let found = splat::read(&files[1], &ReadOptions { with_sh_rest: true }).expect("a splat");
    let expected = best_first.iter().map(|index| moved.means_in_world[*index as usize].as_vec3());
    assert!(found.means_in_world.iter().map(DVec3::as_vec3).eq(expected));

    // Another splat is refused; without indices, advice is given.
    moved.means_in_world.reverse();
    ply::write(&other, &moved).expect("writes");
    let error = refused(encoder(&query).args(["--scene", text(&other)]), "moved.ply");
    assert!(error.contains("lies at"), "{error}");
    ply::write(&other, &scene.select(&[0, 1, 2])).expect("writes");
    refused(encoder(&query).args(["--scene", text(&other)]), "3 Gaussians");
}
