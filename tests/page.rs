//! The data of the page, from both programs, against the scores of the command line.

use super::*;
use slag_tests::*;

/// A message of scores: per cell its id and the scores of its Gaussians; `None` for those in no view.
fn scores_of(service: &Service, query: &str) -> Vec<(u32, Vec<Option<f64>>)> {
    let url = format!("{}/v1/view/scores?{query}", service.url);
    let bytes = ureq::get(url).call().expect("answers").body_mut().read_to_vec().expect("bytes");
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"));
    let [least, largest] = [8, 12].map(|at| f64::from(f32::from_bits(word(at))));
    assert_eq!(&bytes[..4], b"SLGS");
    let mut start = 24 + 8 * word(16) as usize;
    let cell = |at: usize| {
        let (id, n) = (word(24 + 8 * at), word(28 + 8 * at) as usize);
        let levels = &bytes[start..start + n];
        start += n;
        let score = |level: &u8| least + f64::from(*level) / 255.0 * (largest - least);
        (id, levels.iter().map(|level| (*level > 0).then(|| score(level))).collect())
    };
    let cells = (0..word(16) as usize).map(cell).collect();
    assert_eq!(start, bytes.len());
    cells
}

/// The robot scores centroids in integers and the store's service in float64; `query` decodes every Gaussian.
#[test]
fn scores_are_those_of_the_command_line() {
    let site = Site::new();
    let robot = site.robot(&[]);
    let (of_store, of_robot) = (scores_of(&site.store, "text=red"), scores_of(&robot, "text=red"));
    let described = site.store.get("/v1/view");
    assert_eq!(described["can_ask"], true);
    assert_eq!(of_store.len(), described["cells"].as_array().expect("cells").len());
    let mut n_compared = 0;
    for (id, on_robot) in &of_robot {
        let (_, in_store) = of_store.iter().find(|(other, _)| other == id).expect("a cell of the store");
        assert_eq!(in_store.len(), on_robot.len());
        for (a, b) in in_store.iter().zip(on_robot) {
            match (a, b) {
                (Some(a), Some(b)) => assert!((a - b).abs() < 0.02, "{a} {b}"),
                (None, None) => {}
                other => panic!("{other:?}"),
            }
            n_compared += 1;
        }
    }
    assert!(n_compared > 1000, "{n_compared}");

    let file = site.cache().with_file_name("scores.npy");
    let store = site.cache().with_file_name("store");
    let query = ["query", "--store", text(&store), "--models", "colours", "--profile", "compact", "red"];
    run(encoder(&query).args(["--scores", text(&file)]));
    let mut expected: Vec<f32> = read_npy::<f32>(&file).into_iter().filter(|score| !score.is_nan()).collect();
    let mut found: Vec<f64> = of_store.iter().flat_map(|(_, scores)| scores).copied().flatten().collect();
    assert_eq!(found.len(), expected.len());
    expected.sort_by(f32::total_cmp);
    found.sort_by(f64::total_cmp);
    for (found, expected) in found.iter().zip(&expected) {
        assert!((found - f64::from(*expected)).abs() < 0.01, "{found} {expected}");
    }
    assert!(expected[expected.len() - 1] - expected[0] > 0.5, "the question tells Gaussians apart");
}

/// Balanced shards of a store show colours; compact ones, which robots fetch, have the same positions only.
#[test]
fn a_store_shows_colours_that_compact_shards_lack() {
    let site = Site::new();
    let robot = site.robot(&[]);
    let id = &site.store.get("/v1/view")["cells"][0]["cell"];
    let cell_of = |service: &Service| {
        let url = format!("{}/v1/view/cells/{id}", service.url);
        ureq::get(url).call().expect("answers").body_mut().read_to_vec().expect("bytes")
    };
    let (of_store, of_robot) = (cell_of(&site.store), cell_of(&robot));
    let flags = |bytes: &[u8]| u32::from_le_bytes(bytes[24..28].try_into().expect("4 bytes"));
    assert_eq!((flags(&of_store) & 1, flags(&of_robot) & 1), (1, 0));
    // The cell's head, and its centres of 6 bytes.
    let n = u32::from_le_bytes(of_store[8..12].try_into().expect("4 bytes")) as usize;
    let places = 32..32 + 6 * n;
    assert!(n > 100 && of_store[..24] == of_robot[..24] && of_store[places.clone()] == of_robot[places]);
}

/// Objects of balanced shards carry a picture: the box in their best photo. Oracle: the mean colour of that part
/// of the generated photo.
#[test]
fn things_carry_pictures_of_themselves() {
    let site = Site::new();
    let cache = site.cache().with_file_name("balanced");
    let at =
        ["fetch", "--trust-first", "--from", &site.store.url, "--profile", "balanced", "--at", "3.5,2.7,0"];
    run(edge(&at).args(["--cache", text(&cache)]));
    let robot = Service::start(&mut edge(&["serve", "--models", "colours", "--cache", text(&cache)]));
    let photos = generated(&ROOM);
    let objects = robot.get("/v1/objects?limit=1000")["objects"].clone();
    let objects = objects.as_array().expect("objects");
    assert!(objects.len() > 5);
    for object in objects {
        let path = format!("/v1/objects/{}/thumbnail", object["id"].as_str().expect("an id"));
        let picture_of = |service: &Service| {
            let url = format!("{}{path}", service.url);
            ureq::get(url).call().expect("a picture").body_mut().read_to_vec().expect("bytes")
        };
        let picture = picture_of(&robot);
        assert_eq!(picture, picture_of(&site.store));
        let picture = image::load_from_memory_with_format(&picture, image::ImageFormat::Jpeg).unwrap();
        let photo = photos.join("images").join(object["evidence"]["photo"].as_str().expect("a name"));
        let photo = image::open(photo).expect("a photo").to_rgb8();
        let edges: Vec<u32> =
            (0..4).map(|at| object["evidence"]["box_px"][at].as_u64().expect("px") as u32).collect();
        let margin = (0.15 * f64::from((edges[2] - edges[0]).max(edges[3] - edges[1]))).round() as u32;
        let [x0, y0] = [0, 1].map(|at| edges[at].saturating_sub(margin));
        let (x1, y1) = ((edges[2] + margin).min(photo.width()), (edges[3] + margin).min(photo.height()));
        let cut = image::imageops::crop_imm(&photo, x0, y0, x1 - x0, y1 - y0).to_image();
        for (found, expected) in mean_colour(&picture.to_rgb8()).iter().zip(mean_colour(&cut)) {
            assert!((found - expected).abs() < 4.0, "{path}: {found} {expected}");
        }
    }
    let on_compact = site.robot(&[]);
    assert_eq!(on_compact.get("/v1/objects")["objects"][0]["evidence"]["has_thumbnail"], false);
}

fn mean_colour(picture: &image::RgbImage) -> [f64; 3] {
    let n = f64::from(picture.width() * picture.height());
    [0, 1, 2].map(|channel| picture.pixels().map(|pixel| f64::from(pixel[channel])).sum::<f64>() / n)
}

/// The store's service answers like the robot: same objects, scores and places.
#[test]
fn the_store_finds_what_the_robot_finds() {
    let site = Site::new();
    let robot = site.robot(&[]);
    let ask = |service: &Service| service.get("/v1/query?text=red&limit=100")["results"][0].clone();
    let (of_store, of_robot) = (ask(&site.store), ask(&robot));
    let places = |result: &serde_json::Value| {
        let mut found: Vec<(String, f64)> = (result["answers"].as_array().expect("answers").iter())
            .map(|a| (a["id"].as_str().expect("an id").to_owned(), a["score"].as_f64().expect("a score")))
            .collect();
        found.sort_by(|a, b| a.0.cmp(&b.0));
        found
    };
    let (of_store, of_robot) = (places(&of_store), places(&of_robot));
    assert!(!of_robot.is_empty());
    for (id, score) in &of_robot {
        let (_, same) = of_store.iter().find(|(other, _)| other == id).expect("the store has it, too");
        assert!((same - score).abs() < 0.02, "{id}: {same} {score}");
    }
    let store = site.cache().with_file_name("store");
    let mut query =
        encoder(&["query", "--store", text(&store), "--models", "colours", "red", "--limit", "100"]);
    let found = places(&json!({ "answers": run_json(&mut query)["things"] }));
    assert_eq!(found, of_store, "the command line's, too");
}

/// Both programs suggest names of objects: the robot's list, then its other words.
#[test]
fn suggestions_are_the_names_of_things() {
    let site = Site::new();
    let robot = site.robot(&[]);
    let listed = robot.get("/v1/objects?limit=1000");
    let best = |object: &serde_json::Value| object["names"][0]["name"].as_str().expect("a name").to_owned();
    let best: Vec<String> = listed["objects"].as_array().expect("objects").iter().map(best).collect();
    assert!(best.iter().any(|name| name == "red"), "{listed}");
    for service in [&site.store, &robot] {
        let found = service.get("/v1/view/words");
        assert_eq!(found["complete"], true);
        let words = found["words"].as_array().expect("words");
        assert_eq!(words.len(), 14, "11 colours and 3 shapes: {found}");
        for word in words {
            let n_things = best.iter().filter(|name| **name == word["word"]).count();
            assert_eq!(word["n_things"], n_things, "{found}");
        }
    }
}
