//! The objects on board: names, order, positions, tables and maps.

use slag_common::container::AlignedBytes;
use slag_common::frames::Aabb;
use slag_common::shard::ShardLayout;
use slag_common::shard::sample::{SampleObject, SampleObjects};

use super::*;

const FIRST: &str = "o0000000000000001";
const SECOND: &str = "o0000000000000002";
const THIRD: &str = "o0000000000000003";
const PICTURE: [u8; 6] = [0xff, 0xd8, 0xff, 0xe0, 1, 2];

/// Three objects along x, by id: two of axis 1 and one of axis 0. The second has the largest face, the third the
/// largest volume.
fn things() -> [BuiltShard; 1] {
    let [room] = room_with(None);
    let thing = |id: u64, axis: usize, edges: [f64; 3], runs: [u32; 2]| {
        let at = DVec3::X * id as f64;
        SampleObject {
            id,
            position_in_world: at,
            bounds: Aabb { min: at - DVec3::from(edges) / 2.0, max: at + DVec3::from(edges) / 2.0 },
            vectors: (0..9).map(|i| f32::from(i % 3 == axis)).collect(),
            runs: std::iter::once(runs[0]..runs[1]).collect(),
            n_gaussians: runs[1] - runs[0],
            photo: format!("{id}, \"a\".jpg"),
            photo_box_px: [1, 2, 30, 40],
            thumbnail: if id == 2 { PICTURE.to_vec() } else { Vec::new() },
        }
    };
    let objects = vec![
        thing(1, 1, [0.2, 0.2, 0.2], [64, 128]),
        thing(2, 1, [0.5, 0.5, 3.0], [0, 64]),
        thing(3, 0, [1.6, 0.9, 0.7], [128, 500]),
    ];
    let objects = SampleObjects { objects, score_mean: 0.0, score_spread: 0.1, score_error_bound: 0.005 };
    let bytes = AlignedBytes::copy_of(&objects.add_to(&room.view(), Additions::default()));
    let layout = ShardLayout::check(&bytes).expect("a valid shard");
    [BuiltShard { bytes, layout, embeddings: room.embeddings.clone() }]
}

/// One of three objects has a thumbnail.
#[tokio::test]
async fn things_have_their_own_pictures() {
    let service = Service::new(Some(&things()), Settings::default());
    let response = service.send("GET", &format!("/v1/objects/{SECOND}/thumbnail")).await;
    assert_eq!(response.status(), StatusCode::OK);
    assert_eq!(response.headers()["content-type"], "image/jpeg");
    assert_eq!(to_bytes(response.into_body(), 1 << 20).await.expect("a body"), &PICTURE[..]);
    for (id, has_one) in [(FIRST, false), (SECOND, true), (THIRD, false)] {
        let (_, _, object) = service.get(&format!("/v1/objects/{id}")).await;
        assert_eq!(object["evidence"]["has_thumbnail"], has_one, "{id}");
        if !has_one {
            let (status, _, problem) = service.get(&format!("/v1/objects/{id}/thumbnail")).await;
            let expected = (StatusCode::NOT_FOUND, "urn:slag:problem:no-thumbnail");
            assert_eq!((status, problem["type"].as_str().expect("a type")), expected);
        }
    }
    let (status, _, problem) = service.get("/v1/objects/o00000000000000ff/thumbnail").await;
    let expected = (StatusCode::NOT_FOUND, "urn:slag:problem:no-such-object");
    assert_eq!((status, problem["type"].as_str().expect("a type")), expected);
    assert_eq!(service.get("/v1/objects/7/thumbnail").await.0, StatusCode::BAD_REQUEST);
}

async fn ids_of(service: &Service, query: &str) -> Vec<String> {
    let page = service.ok(&format!("/v1/objects?{query}")).await;
    let objects = page["objects"].as_array().expect("a list");
    objects.iter().map(|object| object["id"].as_str().expect("an id").to_owned()).collect()
}

/// Each object is named by its axis, and none by the third.
#[tokio::test]
async fn things_have_their_best_names() {
    let service = Service::new(Some(&things()), Settings::default());
    let (_, _, page) = service.get("/v1/objects").await;
    assert_eq!(page["named"], true);
    for (object, expected) in page["objects"].as_array().expect("a list").iter().zip(["1", "1", "0"]) {
        let names = object["names"].as_array().expect("names");
        assert_eq!((&names[0]["name"], names.len()), (&json!(expected), 3), "{object}");
        let confidence = |at: usize| names[at]["confidence"].as_f64().expect("a number");
        assert!(confidence(0) > 5.0 * confidence(1) && confidence(1) >= confidence(2), "{object}");
        assert!((0.0..=1.0).contains(&(confidence(0) + confidence(1) + confidence(2))), "{object}");
        let id = object["id"].as_str().expect("an id");
        assert_eq!(&service.get(&format!("/v1/objects/{id}")).await.2, object);
    }
}

#[tokio::test]
async fn things_are_sorted_and_paged() {
    let service = Service::new(Some(&things()), Settings::default());
    let by_area = [SECOND, THIRD, FIRST];
    assert_eq!(ids_of(&service, "sort=area").await, by_area);
    assert_eq!(ids_of(&service, "sort=name").await, [THIRD, FIRST, SECOND]);
    assert_eq!(ids_of(&service, &format!("sort=area&limit=1&after={SECOND}")).await, by_area[1..2]);
    assert_eq!(ids_of(&service, &format!("sort=area&after={}", by_area[2])).await, [""; 0]);
    // By id, any id is a valid start.
    assert_eq!(ids_of(&service, "after=o0000000000000000").await.len(), 3);
    for bad in ["sort=area&after=o0000000000000000", "sort=size", "format=xml"] {
        assert_eq!(service.get(&format!("/v1/objects?{bad}")).await.0, StatusCode::BAD_REQUEST, "{bad}");
    }
}

#[tokio::test]
async fn things_are_listed_by_region() {
    let service = Service::new(Some(&things()), Settings::default());
    let (low, high) = (0.9, 2.5);
    let inside = [FIRST, SECOND];
    assert_eq!(ids_of(&service, &format!("box={low},-9,-9,{high},9,9")).await, inside);
    assert_eq!(ids_of(&service, &format!("polygon={low},-9,{high},-9,{high},9,{low},9")).await, inside);
    assert_eq!(service.get("/v1/objects?near_lat_lon=46,7&radius=1").await.0, StatusCode::BAD_REQUEST);
}

/// A line and a point for each object; the middle of the map is the scene's origin.
#[tokio::test]
async fn things_become_tables_and_maps() {
    let shards = things();
    let service = Service::new(Some(&shards), Settings::default());
    let (status, headers, table) = service.get("/v1/objects?format=csv").await;
    assert_eq!((status, &headers["content-type"]), (StatusCode::OK, &"text/csv".parse().expect("a value")));
    let lines = table.as_str().expect("text").split_terminator("\r\n");
    let lines: Vec<Vec<&str>> = lines.map(|line| line.split(',').collect()).collect();
    // Each photo's name has a comma, and so is quoted.
    assert!(lines.len() == 4 && lines[1..].iter().all(|line| line.len() == lines[0].len() + 1), "{table}");
    assert_eq!(lines[1][17..], ["\"1", " \"\"a\"\".jpg\""]);
    let (_, _, page) = service.get("/v1/objects").await;
    for (line, object) in lines[1..].iter().zip(page["objects"].as_array().expect("a list")) {
        assert_eq!(line[0], object["id"].as_str().expect("an id"));
        assert_eq!(line[1], object["names"][0]["name"].as_str().expect("a name"));
        let number = |at: usize| line[at].parse::<f64>().expect("a number");
        assert_eq!(number(7), object["position_in_world"][0].as_f64().expect("a number"));
        assert_eq!(line[10], "", "no place on the earth");
    }
    assert_eq!(service.get("/v1/objects?format=geojson").await.0, StatusCode::BAD_REQUEST);
    let origin = Geographic { latitude_deg: 46.0, longitude_deg: 7.0, height_m: 500.0 };
    let manifest = Manifest { geo_reference: Some(GeoReference { origin }), ..manifest_of(&shards, 2) };
    write_manifest(service.dir.path(), &shards, manifest);
    service.app.reload_now();
    let (_, headers, map) = service.get("/v1/objects?format=geojson&near_lat_lon=46,7,500&radius=50").await;
    assert_eq!(headers["content-type"], "application/geo+json");
    let features = map["features"].as_array().expect("features");
    let (_, _, page) = service.get("/v1/objects").await;
    assert_eq!(features.len(), 3, "{map}");
    for (feature, object) in features.iter().zip(page["objects"].as_array().expect("a list")) {
        let place = &object["geographic"];
        let expected = json!([place["longitude_deg"], place["latitude_deg"], place["height_m"]]);
        assert_eq!((&feature["geometry"]["coordinates"], &feature["id"]), (&expected, &object["id"]));
        assert_eq!(feature["properties"]["name"], object["names"][0]["name"]);
    }
}
