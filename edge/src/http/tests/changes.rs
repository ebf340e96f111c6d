//! Changes between generations: `GET /v1/changes`.

use super::*;
use crate::query::MAX_TEXTS;
use crate::store::{OldShard, Snapshot, history};

/// 20 Gaussians at x = 3, and objects at x = their ids, each along the axis of its id modulo 3. Different objects
/// come from different splats.
fn shards(ids: &[u64]) -> [BuiltShard; 1] {
    [with_things(&cell(1, 3.0, ids), ids, |id| (0..3).map(|axis| f32::from(axis == id % 3)).collect())]
}

fn with_things(shard: &BuiltShard, ids: &[u64], vector: impl Fn(u64) -> Vec<f32>) -> BuiltShard {
    let objects = (0u32..).zip(ids).map(|(at, id)| TestObject {
        id: *id,
        vectors: vector(*id),
        runs: std::iter::once(2 * at..2 * at + 2).collect(),
        n_gaussians: 40,
    });
    shard.with_objects(&objects.collect::<Vec<_>>(), CALIBRATION)
}

/// 20 Gaussians of axis 0 in a cell of 656 units from x on; another splat for other objects.
fn cell(cell_id: u32, x: f64, ids: &[u64]) -> BuiltShard {
    at(cell_id, x, ids).build(false)
}

fn at(cell_id: u32, x: f64, ids: &[u64]) -> TestShard {
    let y = ids.iter().sum::<u64>() as u16;
    let member = |i: u16| Member { steps: [i, y, 0], embedding: vec![1.0, 0.0, 0.0] };
    let shard = TestShard::new(vec![(0..20).map(member).collect()]);
    TestShard { cell_id, origin: DVec3::new(x, 0.0, 0.0), ..shard }
}

/// Records the generation on board as an earlier one, as fetching the next generation does.
fn remember(cache: &EdgeCache) -> history::Record {
    let snapshot = Snapshot::open(cache).expect("opens");
    let shards = snapshot.shards.iter().map(|shard| &**shard);
    let record = history::Record::collect(&snapshot.manifest, DVec3::ZERO, shards).expect("objects");
    fs_err::create_dir_all(history::dir(cache)).expect("a folder");
    fs_err::write(history::path(cache, snapshot.manifest.generation), record.to_bytes()).expect("writes");
    record
}

fn ids<'a>(body: &'a Value, list: &str) -> Vec<&'a str> {
    body[list].as_array().expect("a list").iter().filter_map(|thing| thing["id"].as_str()).collect()
}

#[tokio::test]
async fn generations_are_compared_over_http() {
    let service = Service::new(Some(&shards(&[6, 10, 20])), Settings::default());
    let record = remember(service.app.engine.cache());
    let read = history::Record::parse(&record.to_bytes()).expect("what it wrote");
    for (read, written) in read.things.iter().zip(&record.things) {
        assert_eq!(read.id, written.id);
        assert_eq!(read.photo, written.photo);
        assert_eq!(read.box_in_world, written.box_in_world);
        assert!(read.vector.iter().zip(&written.vector).all(|(a, b)| (a - b).abs() < 0.01), "{read:?}");
    }
    // The first generation has none before it, not even where one is named.
    let (_, _, first) = service.get("/v1/changes?from=1").await;
    assert_eq!(first["none"]["kind"], "no-earlier-generation", "{first:#}");
    assert_eq!(service.get("/v1/changes?from=99").await.0, StatusCode::NOT_FOUND);
    // By hand: 6 stays, 10 and 20 go; 33 is as 6, and 22 as 10, which moved by 12; 20 has no successor. The encoder's
    // clock has gone back: generations are ordered by number.
    let later = shards(&[6, 22, 33]);
    let manifest = Manifest { created_unix_secs: record.created_unix_secs - 60, ..manifest_of(&later, 2) };
    write_manifest(service.dir.path(), &later, manifest);
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
    assert_eq!((&body["from"]["generation"], &body["to"]["generation"]), (&json!(1), &json!(2)));
    let created = ["from", "to"].map(|end| body[end]["created_unix_secs"].as_u64());
    assert_eq!(created, [Some(record.created_unix_secs), Some(record.created_unix_secs - 60)]);
    assert_eq!(ids(&body, "appeared"), ["o0000000000000021"], "{body:#}");
    assert_eq!(ids(&body, "went"), ["o0000000000000014"], "{body:#}");
    let moved = &body["moved"][0];
    assert_eq!(moved["from"]["id"], "o000000000000000a");
    assert_eq!(moved["to"]["id"], "o0000000000000016");
    assert_eq!((&moved["distance"], &body["n_same"]), (&json!(12.0), &json!(1)), "{body:#}");
    let went = &body["went"][0];
    assert_eq!(
        [&went["box_min_in_world"], &went["box_max_in_world"], &went["n_gaussians_in_scene"], &went["photo"]],
        [&json!([19.0, -1.0, -1.0]), &json!([21.0, 1.0, 1.0]), &json!(40), &json!("20.jpg")]
    );
    // One end of a move in the ball suffices.
    let (_, near) = get("?near=10,0,0&radius=2").await;
    assert_eq!((near["moved"].as_array().map(Vec::len), &near["went"]), (Some(1), &json!([])), "{near:#}");
    let (_, near) = get("?near=22,0,0&radius=1").await;
    assert_eq!((near["moved"].as_array().map(Vec::len), &near["went"]), (Some(1), &json!([])), "{near:#}");
    // This scene has no origin, so latitude and longitude are refused.
    assert_refused(&service.get("/v1/changes?near_lat_lon=46,7&radius=2").await, "near_lat_lon", "no origin");
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

/// Cell 2 of the second generation is missing: its shard of the first stands in. By hand: 10 went from cell 1;
/// whether 1002 is still in cell 2 is unknown, although the old shard on board has it.
#[tokio::test]
async fn shards_that_stand_in_say_nothing_of_their_generation() {
    let axis_0 = |_| vec![1.0, 0.0, 0.0];
    let things = |cell_1: &[u64], cell_2: &[u64]| {
        let made = |cell_id, x, ids: &[u64]| with_things(&cell(cell_id, x, ids), ids, axis_0);
        [made(1, 3.0, cell_1), made(2, 1000.0, cell_2)]
    };
    let old = things(&[6, 10], &[1002]);
    let service = Service::new(Some(&old), Settings::default());
    let cache = service.app.engine.cache();
    remember(cache);
    let first = cache.current().expect("reads").expect("there");
    write_cache(service.dir.path(), &things(&[6], &[1002, 1005]), 2);
    let mut current = cache.current().expect("reads").expect("there");
    let stand_in = &first.cells[1];
    current.cells.truncate(1);
    current.bad_cells = vec![BadCell {
        cell_id: 2,
        fault: CellFault::Missing,
        old: Some(OldShard {
            generation: 1,
            manifest_hash: first.manifest_hash,
            hash: stand_in.hash,
            len_bytes: stand_in.len_bytes,
        }),
    }];
    fs_err::write(cache.current_path(), serde_json::to_vec(&current).expect("JSON")).expect("writes");
    service.app.reload_now();
    let (_, _, body) = service.get("/v1/changes").await;
    assert_eq!(ids(&body, "went"), ["o000000000000000a"], "{body:#}");
    let counts = ["n_same", "n_stayed", "n_not_compared"].map(|name| &body[name]);
    assert_eq!(counts, [&json!(1), &json!(0), &json!(1)], "{body:#}");
    assert_eq!((&body["appeared"], &body["moved"]), (&json!([]), &json!([])), "{body:#}");
}

/// The middle of the earth's map is the scene's origin; 1 degree of latitude is 111 km.
#[tokio::test]
async fn changes_are_placed_on_the_earth() {
    let service = Service::new(Some(&shards(&[6, 10])), Settings::default());
    remember(service.app.engine.cache());
    let origin = Geographic { latitude_deg: 46.0, longitude_deg: 7.0, height_m: 500.0 };
    let shards = shards(&[6]);
    let manifest = Manifest { geo_reference: Some(GeoReference { origin }), ..manifest_of(&shards, 2) };
    write_manifest(service.dir.path(), &shards, manifest);
    service.app.reload_now();
    let went = async |query: &str| {
        let body = service.ok(&format!("/v1/changes?{query}")).await;
        body["went"].clone()
    };
    // 10 m east of the origin lies the object that went.
    let thing = &went("near_lat_lon=46,7&radius=11").await[0];
    assert_eq!(thing["id"], "o000000000000000a");
    let east = thing["geographic"]["longitude_deg"].as_f64().expect("a number") - 7.0;
    let by_hand = (10.0 / (6_378_137.0 * 46f64.to_radians().cos())).to_degrees();
    assert!((east / by_hand - 1.0).abs() < 0.01, "{east} {by_hand}");
    assert_eq!(went("near_lat_lon=46,7&radius=9").await, json!([]));
    assert_eq!(went("near_lat_lon=46.001,7&radius=11").await, json!([]));
    assert_eq!(went("near_lat_lon=46,7,600&radius=11").await, json!([]), "100 m above");
}

/// A vector longer than 1 along the diagonal of axes 0 and 1 has the cosine of 45 degrees with both.
#[tokio::test]
async fn likeness_is_a_cosine_whatever_the_lengths() {
    let vector = |id| if id == 10 { vec![1.5, 1.5, 0.0] } else { vec![0.0, 0.0, 3.0] };
    let of = |ids: &[u64]| [with_things(&cell(1, 3.0, ids), ids, vector)];
    let service = Service::new(Some(&of(&[6])), Settings::default());
    remember(service.app.engine.cache());
    write_cache(service.dir.path(), &of(&[6, 10]), 2);
    service.app.reload_now();
    let (_, _, body) = service.get("/v1/changes?text=2&text=1").await;
    let like = &body["appeared"][0]["like"];
    let score = like["score"].as_f64().expect("a number");
    assert!(like["text"] == "1" && (score - std::f64::consts::FRAC_1_SQRT_2).abs() < 0.01, "{body:#}");
}

/// Vectors of another encoder do not compare with a text's; objects alone still compare.
#[tokio::test]
async fn texts_need_the_encoder_of_the_scene() {
    let of = |ids: &[u64]| {
        let shard = TestShard { encoder_id: Hash32([9; 32]), ..at(1, 3.0, ids) }.build(false);
        [with_things(&shard, ids, |_| vec![1.0, 0.0, 0.0])]
    };
    let service = Service::new(Some(&of(&[6])), Settings::default());
    remember(service.app.engine.cache());
    write_cache(service.dir.path(), &of(&[6, 10]), 2);
    service.app.reload_now();
    let (status, _, body) = service.get("/v1/changes?text=0").await;
    assert_eq!(status, StatusCode::CONFLICT, "{body:#}");
    assert_eq!(body["type"], "urn:slag:problem:encoder-mismatch", "{body:#}");
    let (status, _, body) = service.get("/v1/changes").await;
    assert_eq!((status, ids(&body, "appeared")), (StatusCode::OK, vec!["o000000000000000a"]), "{body:#}");
}
