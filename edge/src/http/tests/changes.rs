//! What changed between generations: `GET /v1/changes`.

use slag_common::manifest::Calibration;

use super::openapi::{check, description};
use super::*;
use crate::query::MAX_TEXTS;
use crate::store::{Snapshot, history};
use crate::testing::TestObject;

/// 20 Gaussians at x = 3, and objects at x = their ids, each along the axis of its id modulo 3.
fn shards(ids: &[u64]) -> [BuiltShard; 1] {
    let objects = (0u32..).zip(ids).map(|(at, id)| TestObject {
        id: *id,
        vectors: (0..3).map(|axis| f32::from(axis == id % 3)).collect(),
        runs: std::iter::once(2 * at..2 * at + 2).collect(),
        n_gaussians: 40,
    });
    let calibration = Calibration { score_mean: 0.0, score_spread: 0.1 };
    [chair(None)[0].with_objects(&objects.collect::<Vec<_>>(), calibration)]
}

#[tokio::test]
async fn generations_are_compared_over_http() {
    let service = Service::new(Some(&shards(&[6, 10, 20])), Settings::default());
    let snapshot = Snapshot::open(service.app.engine.cache()).expect("opens");
    let shards_of = snapshot.shards.iter().map(|shard| &**shard);
    let record = history::Record::collect(&snapshot.manifest, DVec3::ZERO, shards_of).expect("objects");
    let read = history::Record::parse(&record.to_bytes()).expect("what it wrote");
    for (read, written) in read.things.iter().zip(&record.things) {
        assert_eq!(
            (read.id, &read.photo, read.box_in_world),
            (written.id, &written.photo, written.box_in_world)
        );
        assert!(read.vector.iter().zip(&written.vector).all(|(a, b)| (a - b).abs() < 0.01), "{read:?}");
    }
    fs_err::create_dir_all(history::dir(service.app.engine.cache())).expect("a folder");
    fs_err::write(history::path(service.app.engine.cache(), 1), record.to_bytes()).expect("writes");
    // By hand: 6 stays, 10 and 20 go; 33 is as 6, and 22 as 10, which moved by 12; 20 has no successor.
    write_cache(service.dir.path(), &shards(&[6, 22, 33]), 2);
    service.app.reload_now();
    let get = async |query: &str| {
        let (status, _, body) = service.get(&format!("/v1/changes{query}")).await;
        let api = description();
        let response = &api["paths"]["/v1/changes"]["get"]["responses"][status.as_str()]["content"];
        let kind = if status == StatusCode::OK { "application/json" } else { "application/problem+json" };
        assert_eq!(check(&response[kind]["schema"], &body, ""), Ok(()), "{query}: {body:#}");
        (status, body)
    };
    let (_, body) = get("").await;
    let ids = |name: &str| -> Vec<&str> {
        body[name].as_array().expect("a list").iter().filter_map(|thing| thing["id"].as_str()).collect()
    };
    assert_eq!((&body["from"]["generation"], &body["to"]["generation"]), (&json!(1), &json!(2)));
    assert_eq!(ids("appeared"), ["o0000000000000021"], "{body:#}");
    assert_eq!(ids("went"), ["o0000000000000014"], "{body:#}");
    let moved = &body["moved"][0];
    assert_eq!(
        (&moved["from"]["id"], &moved["to"]["id"]),
        (&json!("o000000000000000a"), &json!("o0000000000000016"))
    );
    assert_eq!((&moved["distance"], &body["n_same"]), (&json!(12.0), &json!(1)), "{body:#}");
    // Of a move, one end in the ball counts.
    let (_, near) = get("?near=10,0,0&radius=2").await;
    assert_eq!((near["moved"].as_array().map(Vec::len), &near["went"]), (Some(1), &json!([])), "{near:#}");
    let (_, near) = get("?near=22,0,0&radius=1").await;
    assert_eq!((near["moved"].as_array().map(Vec::len), &near["went"]), (Some(1), &json!([])), "{near:#}");
    // Texts are axes: 33 is along axis 0, 20 along axis 2.
    let (_, named) = get("?text=0&text=2").await;
    assert_eq!(named["appeared"][0]["like"]["text"], "0", "{named:#}");
    assert_eq!(named["went"][0]["like"]["text"], "2", "{named:#}");
    for (query, status) in [
        ("?from=7&to=8", StatusCode::NOT_FOUND),
        ("?from=2", StatusCode::BAD_REQUEST),
        ("?near=1,2,3", StatusCode::BAD_REQUEST),
        ("?radius=3", StatusCode::BAD_REQUEST),
        ("?near=1,2,3&radius=0", StatusCode::BAD_REQUEST),
        ("?text=sofa", StatusCode::UNPROCESSABLE_ENTITY),
        (&format!("?text=0{}", "&text=0".repeat(MAX_TEXTS)), StatusCode::BAD_REQUEST),
        ("?word=0", StatusCode::BAD_REQUEST),
    ] {
        let (found, body) = get(query).await;
        assert_eq!(found, status, "{query}: {body:#}");
    }
}
