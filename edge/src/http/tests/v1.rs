//! Version 1 of the API: reply type, areas, pages, relations, objects on board, events.

use futures_util::StreamExt;

use super::*;
use crate::query::map_status;

/// Gaussians on a lattice between two corners, in steps of 0.01.
fn lattice(from: [u16; 3], to: [u16; 3], n: [u16; 3], axis: usize) -> Vec<Member> {
    let at = |i: u16, n: u16, from: u16, to: u16| from + (to - from) * i / (n - 1);
    let embedding: Vec<f32> = (0..3).map(|i| f32::from(i == axis)).collect();
    let mut members = Vec::new();
    for x in 0..n[0] {
        for y in 0..n[1] {
            for z in 0..n[2] {
                let steps =
                    [at(x, n[0], from[0], to[0]), at(y, n[1], from[1], to[1]), at(z, n[2], from[2], to[2])];
                members.push(Member { steps, embedding: embedding.clone() });
            }
        }
    }
    members
}

/// Two mugs (axis 0), one on a table (axis 1), and nothing of axis 2. Metres: the table is 1.6 x 0.9 x 0.74 in a
/// corner of the world, the other mug stands 3 m along x on the floor.
fn room() -> [BuiltShard; 1] {
    room_with(None)
}

/// The same, with occupancy.
pub(super) fn room_with(places: Option<&BuiltOccupancy>) -> [BuiltShard; 1] {
    room_of(3, places)
}

/// The room with its first objects alone.
pub(super) fn room_of(n_objects: usize, places: Option<&BuiltOccupancy>) -> [BuiltShard; 1] {
    let mugs = [
        lattice([50, 40, 75], [60, 50, 88], [4, 4, 4], 0),
        lattice([300, 40, 0], [310, 50, 13], [4, 4, 4], 0),
    ];
    let table = lattice([0, 0, 0], [160, 90, 74], [9, 7, 6], 1);
    let ends = [0u32, 64, 128, 128 + table.len() as u32];
    let shard = TestShard::new(vec![mugs.concat(), table]).build(false);
    let object = |id: u64, axis: usize, at: usize| TestObject {
        id,
        vectors: (0..9).map(|i| f32::from(i % 3 == axis)).collect(),
        runs: std::iter::once(ends[at]..ends[at + 1]).collect(),
        n_gaussians: ends[at + 1] - ends[at],
    };
    let objects = [object(1, 0, 0), object(2, 0, 1), object(3, 1, 2)];
    [shard.with_objects_and_places(&objects[..n_objects], CALIBRATION, places)]
}

async fn post(service: &Service, body: &Value) -> Answered {
    service.post("/v1/query", "application/json", body.to_string()).await
}

fn ids(result: &Value) -> Vec<String> {
    let answers = result["answers"].as_array().expect("answers");
    answers.iter().map(|answer| answer["id"].as_str().expect("an id").to_owned()).collect()
}

const MUG_ON_TABLE: &str = "o0000000000000001";
const MUG_ON_FLOOR: &str = "o0000000000000002";
const TABLE: &str = "o0000000000000003";

#[tokio::test]
async fn get_and_post_answer_in_one_shape() {
    let service = Service::new(Some(&room()), Settings::default());
    let got = service.ok("/v1/query?text=0&text=1&near=0,0,0").await;
    let (status, _, posted) = post(&service, &json!({"texts": ["0", "1"], "near": [0, 0, 0]})).await;
    assert_eq!((status, &got), (StatusCode::OK, &posted));
    let found = (&got["scene"], &got["generation"], &got["frame"], &got["unit"]);
    assert_eq!(found, (&json!("yard"), &json!(1), &json!("world"), &json!("m")));
    let (_, _, one) = service.get("/v1/query?text=1&near=0,0,0").await;
    assert_eq!(one["results"][0], got["results"][1], "one question has the shape of many");
    assert_eq!(ids(&got["results"][0]), [MUG_ON_TABLE, MUG_ON_FLOOR]);
    let answer = &got["results"][0]["answers"][0];
    assert_eq!((&answer["frame"], &answer["generation"]), (&json!("world"), &json!(1)));
    // The same vector without the text model; its length is ignored.
    let (status, _, vector) =
        post(&service, &json!({"vectors": [[5.0, 0.0, 0.0], [0.0, 0.5, 0.0]], "near": [0, 0, 0]})).await;
    assert_eq!(status, StatusCode::OK, "{vector}");
    for at in 0..2 {
        let (text, vector) = (&got["results"][at], &vector["results"][at]);
        assert_eq!((&text["answers"], &vector["question"]), (&vector["answers"], &json!({"vector": at})));
    }
    let (_, _, old) = service.get("/query?text=0&near=0,0,0").await;
    for name in ["id", "position_in_world", "score", "relevance", "distance"] {
        assert_eq!(old["answers"][0][name], answer[name], "{name}");
    }
}

#[tokio::test]
async fn pages_are_the_whole_in_pieces() {
    let service = Service::new(Some(&room()), Settings::default());
    for kind in ["gaussians", "objects"] {
        let (_, _, all) = service.get(&format!("/v1/query?text=0&kind={kind}&limit=1000")).await;
        let all = &all["results"][0];
        assert_eq!(all["next_offset"], Value::Null);
        let (mut pages, mut offset) = (Vec::new(), 0);
        loop {
            let uri = format!("/v1/query?text=0&kind={kind}&limit=1&offset={offset}");
            let (_, _, page) = service.get(&uri).await;
            let page = &page["results"][0];
            pages.extend(page["answers"].as_array().expect("answers").clone());
            match page["next_offset"].as_u64() {
                Some(next) => offset = next,
                None => break,
            }
        }
        assert_eq!(all["answers"], Value::Array(pages), "{kind}");
        assert_eq!(all["none"], Value::Null);
        let (_, _, beyond) = service.get(&format!("/v1/query?text=0&kind={kind}&offset={offset}9")).await;
        assert_eq!(beyond["results"][0]["none"]["kind"], "beyond-end", "{beyond:#}");
    }
}

#[tokio::test]
async fn areas_restrict_what_is_found() {
    let service = Service::new(Some(&room()), Settings::default());
    let near = [MUG_ON_TABLE];
    let by_box = json!({"box": {"from": [-1, -1, -1], "to": [2, 2, 2]}});
    let by_ball = json!({"ball": {"centre": [0.5, 0.5, 0.8], "radius": 1.0}});
    let by_polygon = json!({"polygon": [[-1, -1], [2, -1], [2, 2], [-1, 2]]});
    for region in [&by_box, &by_ball, &by_polygon] {
        for text in ["0", "0 near the 1"] {
            let (status, _, body) = post(&service, &json!({"texts": [text], "region": region})).await;
            assert_eq!(status, StatusCode::OK, "{body}");
            assert_eq!(ids(&body["results"][0]).as_slice(), &near.map(str::to_owned)[..], "{body}");
        }
    }
    let (_, _, body) = service.get("/v1/query?text=0&polygon=-1,-1,2,-1,2,2,-1,2").await;
    assert_eq!(ids(&body["results"][0]), near);
    let far = json!({"ball": {"centre": [50, 50, 0], "radius": 1.0}});
    let (_, _, body) = post(&service, &json!({"texts": ["0 on the 1"], "region": far})).await;
    assert_eq!(body["results"][0]["none"]["kind"], "not-in-region", "{body}");
    assert_refused(
        &service.get("/v1/query?text=0&near_lat_lon=47,8&radius=5").await,
        "near_lat_lon",
        "no origin",
    );
}

#[tokio::test]
async fn relations_are_answered_and_say_what_failed() {
    let service = Service::new(Some(&room()), Settings::default());
    let (status, _, body) = service.get("/v1/query?text=0%20on%20the%201").await;
    let result = &body["results"][0];
    assert_eq!((status, ids(result)), (StatusCode::OK, vec![MUG_ON_TABLE.to_owned()]), "{body}");
    let phrase = json!({"thing": "0", "relation": {"is": "on", "of": {"thing": "1"}}});
    assert_eq!(result["understood"], phrase);
    assert_eq!(result["answers"][0]["related_to"][0]["id"], TABLE);
    let (_, _, posted) = post(&service, &json!({"phrases": [phrase]})).await;
    assert_eq!(posted["results"][0]["answers"], result["answers"]);
    // The plain text, unparsed.
    let (_, _, plain) = service.get("/v1/query?text=0%20on%20the%201&relations=off").await;
    assert_eq!(ids(&plain["results"][0]).len(), 2);
    let asks = [
        ("largest 0", vec![MUG_ON_TABLE, MUG_ON_FLOOR], None),
        ("0 beside the 1", vec![], Some(("no-such-pair", "0"))),
        ("0 on the 2", vec![], Some(("no-such-thing", "2"))),
        ("2 on the 1", vec![], Some(("no-such-thing", "2"))),
        ("2nd 0 from the 1", vec![MUG_ON_FLOOR], None),
        ("3rd 0 from the 1", vec![], Some(("too-few", "0"))),
        ("nearest 0", vec![MUG_ON_FLOOR], None),
        ("what is on the 1", vec![MUG_ON_TABLE], None),
        ("nearest thing", vec![MUG_ON_FLOOR], None),
        ("0 in front of the 1", vec![MUG_ON_FLOOR], None),
        ("0 behind the 1", vec![], Some(("no-such-pair", "0"))),
    ];
    for (text, expected, none) in asks {
        let (status, _, body) = post(&service, &json!({"texts": [text], "near": [6, 0.45, 0]})).await;
        let result = &body["results"][0];
        assert_eq!(status, StatusCode::OK, "{text}: {body}");
        // Both mugs have the same size up to rounding.
        let found = ids(result);
        match text {
            "largest 0" => assert!(found.len() == 1 && expected.contains(&found[0].as_str()), "{body}"),
            _ => assert_eq!(found, expected, "{text}: {body}"),
        }
        let failed = none.map(|(kind, thing)| (json!(kind), json!(thing)));
        let failed = failed.unwrap_or_default();
        assert_eq!((&result["none"]["kind"], &result["none"]["thing"]), (&failed.0, &failed.1), "{text}");
    }
}

/// The room with a lamp (axis 2) on the table that is no object, and with the mug on the floor as three objects in a
/// row, the last of which touches the others.
fn room_in_pieces() -> [BuiltShard; 1] {
    let pieces = [
        (lattice([50, 40, 75], [60, 50, 88], [4, 4, 4], 0), Some((1, 0))),
        (lattice([300, 40, 0], [330, 50, 13], [4, 4, 4], 0), Some((2, 0))),
        (lattice([370, 40, 0], [400, 50, 13], [4, 4, 4], 0), Some((4, 0))),
        (lattice([333, 40, 0], [367, 50, 13], [4, 4, 4], 0), Some((5, 0))),
        (lattice([0, 0, 0], [160, 90, 74], [9, 7, 6], 1), Some((3, 1))),
        (lattice([120, 40, 75], [130, 50, 105], [4, 4, 6], 2), None),
    ];
    let (mut members, mut objects, mut end) = (vec![Vec::new(); 3], Vec::new(), 0);
    for (axis, piece) in [0, 0, 0, 0, 1, 2].into_iter().zip(&pieces) {
        let n = piece.0.len() as u32;
        members[axis].extend(piece.0.iter().cloned());
        if let Some((id, axis)) = piece.1 {
            let vectors = (0..9).map(|i| f32::from(i % 3 == axis)).collect();
            let runs = std::iter::once(end..end + n).collect();
            objects.push(TestObject { id, vectors, runs, n_gaussians: n });
        }
        end += n;
    }
    [TestShard::new(members).build(false).with_objects(&objects, CALIBRATION)]
}

/// Clusters answer where no object does, in phrases as in plain questions; touching pieces count once.
#[tokio::test]
async fn phrases_take_clusters_and_whole_things() {
    let service = Service::new(Some(&room_in_pieces()), Settings::default());
    let asks =
        [("2 on the 1", 1, None), ("2nd 0 from the 1", 1, None), ("3rd 0 from the 1", 0, Some("too-few"))];
    for (text, n_answers, none) in asks {
        let (_, _, body) = post(&service, &json!({"texts": [text]})).await;
        let result = &body["results"][0];
        assert_eq!((ids(result).len(), result["none"]["kind"].as_str()), (n_answers, none), "{text}: {body}");
    }
    let (_, _, body) = post(&service, &json!({"texts": ["2 on the 1", "0 near the 2"]})).await;
    let [lamp, beside_it] = [0, 1].map(|at| &body["results"][at]);
    let top = lamp["answers"][0]["box_max_in_world"][2].as_f64().expect("metres");
    assert!((top - 1.05).abs() < 0.05 && lamp["answers"][0]["evidence"].is_null(), "{body}");
    assert_eq!(lamp["answers"][0]["related_to"][0]["id"], TABLE);
    assert_eq!(ids(beside_it), [MUG_ON_TABLE]);
    assert_eq!(beside_it["answers"][0]["related_to"][0]["id"], lamp["answers"][0]["id"]);
    let (_, _, body) = post(&service, &json!({"texts": ["2 on the 1"], "kind": "objects"})).await;
    assert_eq!(body["results"][0]["none"]["kind"], "no-such-thing", "{body}");
    let (_, _, body) = post(&service, &json!({"texts": ["2nd 0 from the 1"]})).await;
    assert_eq!(ids(&body["results"][0]), ["o0000000000000005"], "the largest piece");
}

#[tokio::test]
async fn wrong_requests_are_refused_by_name() {
    let service = Service::new(Some(&room()), Settings::default());
    let cases = [
        (json!({}), "texts"),
        (json!({"texts": vec!["0"; 33]}), "texts"),
        (json!({"texts": ["0"], "colour": 1}), "body"),
        (json!({"texts": ["anything near something"]}), "texts"),
        (json!({"texts": "0"}), "body"),
        (json!({"vectors": [[1.0, 0.0]]}), "vectors"),
        (json!({"vectors": [[0.0, 0.0, 0.0]]}), "vectors"),
        (json!({"vectors": [[1e39, 0.0, 0.0]]}), "body"),
        (json!({"texts": ["0"], "negatives": vec!["1"; 17]}), "negatives"),
        (json!({"texts": ["0"], "limit": 0}), "limit"),
        (json!({"texts": ["0", "1"], "limit": 5001}), "limit"),
        (json!({"texts": ["0"], "offset": 1u64 << 40}), "limit"),
        (json!({"texts": ["0"], "min_score": 3}), "min_score"),
        (json!({"texts": ["0"], "precision": "maybe"}), "body"),
        (json!({"texts": ["0"], "precision": {"exact": null}}), "body"),
        (json!({"texts": ["0"], "kind": {"objects": null}}), "body"),
        (json!({"texts": ["0"], "time_budget_ms": 0}), "time_budget_ms"),
        (json!({"texts": ["0"], "near": [1e12, 0, 0]}), "near"),
        (json!({"texts": ["0"], "region": {"polygon": [[0, 0], [1, 1]]}}), "polygon"),
        (json!({"texts": ["0"], "region": {"polygon": [[0, 0], [1, 1], [2, 2]]}}), "polygon"),
        (
            json!({"texts": ["0"], "region": {"ball": {"centre": {"lat": 1, "lon": 2}, "radius": 1}}}),
            "centre",
        ),
        (json!({"texts": ["0"], "region": {"box": {"from": [0, 0, 0], "to": [1e10, 1, 1]}}}), "box"),
        (json!({"texts": ["0"], "region": {"polygon": []}}), "body"),
        (json!({"texts": ["0"], "region": {"box": {"from": [0, 0, 1], "to": [5, 5, 1]}}}), "box"),
        (json!({"texts": ["0"], "region": {"ball": {"centre": [0, 0, 0], "radius": -1}}}), "radius"),
        (json!({"texts": ["0"], "negatives": ["0"]}), "negatives"),
        (json!({"texts": ["0 x"], "negatives": ["the 0 X"]}), "negatives"),
        (json!({"texts": ["101st nearest 0"], "near": [0, 0, 0]}), "texts"),
        (json!({"texts": ["0 not on 1"]}), "texts"),
        (json!({"texts": [format!("0{}", " on 0".repeat(8))]}), "texts"),
        (json!({"texts": [" "]}), "texts"),
        (json!({"vectors": vec![[1.0, 0.0, 0.0]; 33]}), "vectors"),
        (json!({"texts": ["0 behind the 1"]}), "near"),
        (json!({"texts": ["0 left of me"], "near": [0, 0, 0]}), "heading_rad"),
        (json!({"texts": ["0 left of me"], "near": [0, 0, 0], "heading_rad": 90}), "heading_rad"),
        (json!({"phrases": [{"thing": "me"}]}), "phrases"),
        (json!({"phrases": [{"thing": "0"}], "kind": "clusters"}), "kind"),
    ];
    for (body, parameter) in cases {
        assert_refused(&post(&service, &body).await, parameter, &body.to_string());
    }
    for (query, parameter) in [
        ("text=0&colour=1", "colour"),
        ("text=0&limit=1&limit=2", "limit"),
        ("text=0&radius=3", "near"),
        ("text=0&relations=maybe", "relations"),
        ("text=0&polygon=1,2,3", "polygon"),
        ("text=0&polygon=0,0,1,1,2,2", "polygon"),
        ("text=0&polygon_lat_lon=46,8,47,8,47,9", "polygon_lat_lon"),
        ("text=0&near_lat_lon=47,8", "near_lat_lon"),
        ("text=0&min_score=2", "min_score"),
        ("text=0&negative=%3F", "negative"),
        ("text=0&texts=1", "texts"),
        ("Text=0", "Text"),
        ("q=0", "q"),
        ("box=0,0,0,1,1,1", "text"),
        (&format!("text=0{}", "+on+0".repeat(8)), "text"),
        (&"text=0&".repeat(33), "text"),
    ] {
        let refused = service.get(&format!("/v1/query?{query}")).await;
        assert_refused(&refused, parameter, query);
        let detail = refused.2["detail"].as_str().expect("text");
        assert!(detail.starts_with(&format!("{parameter}: ")), "{detail}");
    }
    assert_refused(&service.get("/v1/goal?text=0&near_lat_lon=47,8").await, "near_lat_lon", "a goal");
    assert_refused(&service.get("/v1/objects?near_lat_lon=47,8&radius=1").await, "near_lat_lon", "a list");
    let marked = format!("\u{feff}{}", json!({"texts": ["0"]}));
    assert_eq!(service.post("/v1/query", "application/json", marked).await.0, StatusCode::OK);
    let (status, _, body) = post(&service, &json!({"texts": ["sofa"]})).await;
    assert_eq!((status.as_u16(), &body["parameter"]), (422, &json!("texts")), "{body}");
    // serde's message is complete: it ends with the position, and lists the names.
    let (_, _, body) = post(&service, &json!({"texts": ["0"], "colour": 1})).await;
    let detail = body["detail"].as_str().expect("text");
    assert!(detail.starts_with("body: unknown field `colour`, expected one of `texts`"), "{detail}");
    assert!(detail.contains("`near`") && detail.len() < 400, "{detail}");
    let (_, _, body) = post(&service, &json!({"texts": ["0"], "limit": "ten"})).await;
    let detail = body["detail"].as_str().expect("text");
    assert!(detail.contains("expected a whole number"), "{detail}");
    // A negative may have a comma.
    let (_, _, reply) = post(&service, &json!({"texts": ["0"], "negatives": ["1 red, 2 blue"]})).await;
    assert_eq!(reply["results"][0]["negatives"], json!(["1 red, 2 blue"]), "{reply}");
    let empty = Service::new(None, Settings::default());
    assert_eq!(post(&empty, &json!({"texts": ["0"]})).await.0, StatusCode::SERVICE_UNAVAILABLE);
}

/// A text of 45 kB, or a phrase as deep, must end neither a thread nor the process.
#[tokio::test]
async fn long_and_deep_questions_are_refused() {
    let service = Service::new(Some(&room_with(Some(&super::goal::places()))), Settings::default());
    let long = format!("a {}", "on a ".repeat(9_000));
    let deep = |n: usize| {
        let levels = r#"{"thing":"a","relation":{"is":"on","of":"#.repeat(n);
        format!(r#"{{"phrases":[{levels}{{"thing":"a"}}{}]}}"#, "}}".repeat(n))
    };
    let bodies = [
        (json!({"texts": [long]}).to_string(), "texts"),
        (json!({"phrases": [{"thing": long}]}).to_string(), "phrases"),
        (json!({"texts": ["0"], "negatives": [long]}).to_string(), "negatives"),
        (deep(8), "phrases"),
        (deep(60), "phrases"),
        (deep(9_000), "body"),
    ];
    for (body, parameter) in bodies {
        assert_refused(&service.post("/v1/query", "application/json", body).await, parameter, "");
    }
    let long = long.replace(' ', "+");
    for path in ["/query", "/v1/query", "/v1/goal", "/v1/changes", "/v1/view/scores"] {
        assert_refused(&service.get(&format!("{path}?text={long}")).await, "text", path);
    }
}

/// Arrays in place of objects are refused: they would be read in member order, and GeoJSON has longitude first.
#[tokio::test]
async fn members_have_names() {
    let service = Service::new(Some(&room()), Settings::default());
    let near = |near: Value| json!({"texts": ["0"], "near": near});
    let region = |region: Value| json!({"texts": ["0"], "region": region});
    let phrase = |phrase: Value| json!({"phrases": [phrase]});
    for body in [
        near(json!([3, 3])),
        near(json!([8.54, 47.37, 400, 1])),
        near(json!([])),
        region(json!({"polygon": [[0, 0, 5], [1, 0, 5], [1, 1, 5]]})),
        region(json!({"ball": [[0, 0, 0], 1]})),
        region(json!({"ball": {"centre": [47, 8], "radius": 1}})),
        region(json!({"box": [[0, 0, 0], [1, 1, 1]]})),
        region(json!([null, null, []])),
        phrase(json!(["0"])),
        phrase(json!({"thing": "0", "pick": ["largest"]})),
        phrase(json!({"thing": "0", "relation": ["on", {"thing": "1"}]})),
        phrase(json!({"thing": "0", "relation": {"is": "on", "of": ["1"]}})),
        json!([["0"]]),
    ] {
        assert_refused(&post(&service, &body).await, "body", &body.to_string());
    }
    let (status, _, reply) = post(&service, &near(json!([3, 3, 0]))).await;
    assert_eq!(status, StatusCode::OK, "{reply}");
}

#[tokio::test]
async fn things_on_board_are_listed_in_pages() {
    let service = Service::new(Some(&room()), Settings::default());
    let (status, _, all) = service.get("/v1/objects").await;
    assert_eq!((status, &all["n_objects"], &all["next_after"]), (StatusCode::OK, &json!(3), &Value::Null));
    let (_, _, first) = service.get("/v1/objects?limit=2").await;
    let after = first["next_after"].as_str().expect("there are more");
    let (_, _, rest) = service.get(&format!("/v1/objects?limit=2&after={after}")).await;
    let mut pages = first["objects"].as_array().expect("a list").clone();
    pages.extend(rest["objects"].as_array().expect("a list").clone());
    assert_eq!((&all["objects"], &rest["next_after"]), (&Value::Array(pages), &Value::Null));
    let (_, _, table) = service.get(&format!("/v1/objects/{TABLE}")).await;
    assert_eq!((&table, &table["frame"]), (&all["objects"][2], &json!("world")));
    // Records of these objects lie along x by their ids.
    let (_, _, near) = service.get("/v1/objects?near=1,0,0&radius=1.5").await;
    assert_eq!(near["n_objects"], 2);
    assert_eq!(service.get("/v1/objects?min_size=2.5").await.2["n_objects"], 0);
    let (status, _, body) = service.get("/v1/objects/o00000000000000ff").await;
    assert_eq!((status, &body["type"]), (StatusCode::NOT_FOUND, &json!("urn:slag:problem:no-such-object")));
    let bad = "objects/1-0 objects?limit=0 objects?after=3 objects?radius=3 objects?near=0,0,0&radius=1e10 \
        objects?box=0,0,1,5,5,1 changes?near=0,0,0&radius=1e10 objects/%ff objects/%ff/thumbnail view/cells/%ff \
        objects?x=1";
    for bad in bad.split(' ') {
        assert_eq!(service.get(&format!("/v1/{bad}")).await.0, StatusCode::BAD_REQUEST, "{bad}");
    }
    let (_, _, map) = service.get("/v1/map").await;
    let found = (&map["n_objects"], &map["cells"][0]["generation"], &map["missing"], &map["z_is_up"]);
    assert_eq!(found, (&json!(3), &json!(1), &json!([]), &json!(true)));
    // Before the generation's time (the robot's clock is behind) there is no age.
    let snapshot = service.app.engine.snapshot().expect("loaded");
    let made = snapshot.manifest.created_unix_secs;
    let at = |now| map_status(&snapshot, now, Some(made + 30));
    let found = [made - 60, made + 60].map(|now| (at(now).age_secs, at(now).is_expired));
    assert_eq!(found, [(0, false), (60, true)]);
}

#[tokio::test]
async fn events_tell_of_generations_until_the_service_stops() {
    let settings = Settings { max_listeners: 1, ..Settings::default() };
    let service = Service::new(Some(&room()), settings);
    let response = soon(service.send("GET", "/v1/events")).await;
    assert_eq!(response.headers()["content-type"], "text/event-stream");
    let mut events = response.into_body().into_data_stream();
    let mut next = async || soon(events.next()).await.map(|event| event.expect("no error"));
    let first = next().await.expect("an event");
    let text = String::from_utf8_lossy(&first);
    assert!(text.starts_with("event: generation\ndata: {") && text.contains("\"generation\":1"), "{text}");
    assert_eq!(service.get("/v1/events").await.0, StatusCode::SERVICE_UNAVAILABLE);
    write_cache(service.dir.path(), &room(), 2);
    assert!(String::from_utf8_lossy(&next().await.expect("an event")).contains("\"generation\":2"));
    service.app.stopping.send_replace(true);
    assert!(next().await.is_none());
}
