//! The things on board: what they are called, in which order, where, and as tables and maps.

use slag_common::frames::{GeoReference, Geographic};
use slag_common::manifest::Manifest;

use super::v1::{MUG_ON_FLOOR, MUG_ON_TABLE, TABLE, room_with};
use super::*;
use crate::testing::{manifest_of, write_manifest};

async fn ids_of(service: &Service, query: &str) -> Vec<String> {
    let (status, _, page) = service.get(&format!("/v1/objects?{query}")).await;
    assert_eq!(status, StatusCode::OK, "{query}: {page}");
    let objects = page["objects"].as_array().expect("a list");
    objects.iter().map(|object| object["id"].as_str().expect("an id").to_owned()).collect()
}

/// Axis 0 are mugs and axis 1 a table: each is called by its axis, and nothing by the third.
#[tokio::test]
async fn things_have_their_best_names() {
    let service = Service::new(Some(&room_with(None)), Settings::default());
    let (_, _, page) = service.get("/v1/objects").await;
    assert_eq!(page["named"], true);
    for (object, expected) in page["objects"].as_array().expect("a list").iter().zip(["0", "0", "1"]) {
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
    let service = Service::new(Some(&room_with(None)), Settings::default());
    let by_area = [TABLE, MUG_ON_TABLE, MUG_ON_FLOOR];
    assert_eq!(ids_of(&service, "sort=area").await, by_area);
    assert_eq!(ids_of(&service, "sort=name").await, [MUG_ON_TABLE, MUG_ON_FLOOR, TABLE]);
    assert_eq!(ids_of(&service, &format!("sort=area&limit=1&after={TABLE}")).await, by_area[1..2]);
    assert_eq!(ids_of(&service, &format!("sort=area&after={}", by_area[2])).await, [""; 0]);
    // By id, any id is a place to begin at.
    assert_eq!(ids_of(&service, "after=o0000000000000000").await.len(), 3);
    for bad in ["sort=area&after=o0000000000000000", "sort=size", "format=xml"] {
        assert_eq!(service.get(&format!("/v1/objects?{bad}")).await.0, StatusCode::BAD_REQUEST, "{bad}");
    }
}

/// Records of these objects lie along x by their ids.
#[tokio::test]
async fn things_are_listed_by_region() {
    let service = Service::new(Some(&room_with(None)), Settings::default());
    let (_, _, all) = service.get("/v1/objects").await;
    let x = |at: usize| all["objects"][at]["position_in_world"][0].as_f64().expect("a number");
    let middle = f64::midpoint(x(1), x(2));
    let (low, high) = (x(0) - 0.1, middle);
    assert!(x(0) < x(1) && x(1) < x(2), "{all}");
    let inside = [MUG_ON_TABLE, MUG_ON_FLOOR];
    assert_eq!(ids_of(&service, &format!("box={low},-9,-9,{high},9,9")).await, inside);
    assert_eq!(ids_of(&service, &format!("polygon={low},-9,{high},-9,{high},9,{low},9")).await, inside);
    assert_eq!(service.get("/v1/objects?near_lat_lon=46,7&radius=1").await.0, StatusCode::BAD_REQUEST);
}

/// A line and a point for each thing; the middle of the map is the scene's origin.
#[tokio::test]
async fn things_become_tables_and_maps() {
    let shards = room_with(None);
    let service = Service::new(Some(&shards), Settings::default());
    let (status, headers, table) = service.get("/v1/objects?format=csv").await;
    assert_eq!((status, &headers["content-type"]), (StatusCode::OK, &"text/csv".parse().expect("a value")));
    let lines: Vec<Vec<&str>> = table
        .as_str()
        .expect("text")
        .split_terminator("\r\n")
        .map(|line| line.split(',').collect())
        .collect();
    assert!(lines.len() == 4 && lines.iter().all(|line| line.len() == lines[0].len()), "{table}");
    let (_, _, page) = service.get("/v1/objects").await;
    for (line, object) in lines[1..].iter().zip(page["objects"].as_array().expect("a list")) {
        assert_eq!(
            (line[0], line[1]),
            (object["id"].as_str().expect("an id"), object["names"][0]["name"].as_str().expect("a name"))
        );
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
