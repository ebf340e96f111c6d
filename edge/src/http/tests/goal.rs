//! Places to stand: `GET /v1/goal` and `GET /v1/floor`.

use slag_common::occupancy::Block;

use super::v1::room_of;
use super::*;

/// Occupancy of the room: a floor from -1 to 5 m along x and to 4 m along y, and the boxes of two mugs and a table.
pub(super) fn places() -> BuiltOccupancy {
    let voxel = 0.1;
    let inside = |p: glam::DVec3, low: [f64; 3], high: [f64; 3]| {
        p.cmpge(low.into()).all() && p.cmplt(high.into()).all()
    };
    let solids = [
        ([-1.0, -1.0, -0.1], [5.0, 4.0, 0.0]),
        ([0.0, 0.0, 0.0], [1.6, 0.9, 0.74]),
        ([0.5, 0.4, 0.74], [0.6, 0.5, 0.88]),
        ([3.0, 0.4, 0.0], [3.1, 0.5, 0.13]),
    ];
    let blocks = (-3..13).flat_map(|x| (-3..10).flat_map(move |y| (-1..4).map(move |z| [x, y, z])));
    let blocks: Vec<Block> = blocks
        .map(|at| {
            let (mut occupied, mut free) = (0u64, 0u64);
            for bit in 0..64i32 {
                let voxels = [4 * at[0] + bit / 16, 4 * at[1] + bit / 4 % 4, 4 * at[2] + bit % 4];
                let centre = (glam::DVec3::from(voxels.map(f64::from)) + 0.5) * voxel;
                let is_solid = solids.iter().any(|(low, high)| inside(centre, *low, *high));
                let is_seen = inside(centre, [-1.0, -1.0, 0.0], [5.0, 4.0, 1.5]);
                occupied |= u64::from(is_solid) << bit;
                free |= u64::from(is_seen && !is_solid) << bit;
            }
            Block { at, occupied, free }
        })
        .collect();
    BuiltOccupancy::pack(voxel, 0.1, 2, &blocks)
}

fn is_as_described(path: &str, body: &Value) {
    let api = description();
    let schema = &api["paths"][path]["get"]["responses"]["200"]["content"]["application/json"]["schema"];
    assert_eq!(check(schema, body, ""), Ok(()), "{body:#}");
}

#[tokio::test]
async fn poses_or_reasons_are_given() {
    let shards = room_with(Some(&places()));
    let service = Service::new(Some(&shards), Settings::default());
    // The mug on the floor is seen; the one on the table is too high, and is named as missed or comes second.
    let body = service.ok("/v1/goal?id=o0000000000000002&near=2,3,0&step_m=0.15").await;
    is_as_described("/v1/goal", &body);
    let goal = &body["goals"][0];
    let at = |name: &str, axis: usize| goal[name][axis].as_f64().expect("a number");
    let (x, y) = (at("position_in_world", 0), at("position_in_world", 1));
    let distance = (3.05 - x).hypot(0.45 - y);
    assert!((0.3..0.9).contains(&distance), "{body:#}");
    let yaw = goal["yaw_rad"].as_f64().expect("a number");
    assert!((yaw - (0.45 - y).atan2(3.05 - x)).abs() < 0.2, "{body:#}");
    let (_, _, high) = service.get("/v1/goal?id=o0000000000000001&near=2,3,0&step_m=0.15").await;
    is_as_described("/v1/goal", &high);
    assert_eq!(high["none"]["kind"], "not-visible");
    assert_eq!(high["goals"].as_array().map(Vec::len), Some(0));
    let (_, _, over) = service
        .get("/v1/goal?id=o0000000000000001&near=2,3,0&step_m=0.15&sensor_height_m=1.2&reach_m=1")
        .await;
    assert!(over["goals"][0]["visible_share"].as_f64() > Some(0.1), "{over:#}");
    // By text: of both mugs the visible one.
    let (_, _, text) = service.get("/v1/goal?text=0&near=2,3,0&step_m=0.15").await;
    is_as_described("/v1/goal", &text);
    assert_eq!(text["thing"]["id"], "o0000000000000002", "{text:#}");
    let (_, _, none) = service.get("/v1/goal?text=2&near=2,3,0&step_m=0.15").await;
    is_as_described("/v1/goal", &none);
    assert_eq!(none["none"]["kind"], "no-such-thing", "{none:#}");
    // "Left of me" depends on the robot's heading.
    let of_side = "/v1/goal?text=0+left+of+me&near=2,3,0&step_m=0.15";
    assert_refused(&service.get(of_side).await, "heading_rad", "nothing");
    let mut kinds = Vec::new();
    for heading_rad in [0.0, std::f64::consts::FRAC_PI_2, std::f64::consts::PI, -std::f64::consts::FRAC_PI_2]
    {
        let body = service.ok(&format!("{of_side}&heading_rad={heading_rad}")).await;
        kinds.push(body["none"]["kind"].as_str().unwrap_or("found").to_owned());
    }
    assert!(kinds.iter().any(|kind| kind == "no-such-thing"), "{kinds:?}");
    assert!(kinds.iter().any(|kind| kind != "no-such-thing"), "{kinds:?}");
    // A robot beyond the known ground.
    let (_, _, away) = service.get("/v1/goal?text=0&near=20,3,0&step_m=0.15").await;
    assert_eq!(away["none"]["kind"], "unknown-ground", "{away:#}");
    assert_refused(&service.get("/v1/goal?near=2,3,0").await, "text", "nothing");
}

/// The table is no object, but its Gaussians answer: the robot goes to what a query finds.
#[tokio::test]
async fn groups_of_gaussians_are_gone_to() {
    let service = Service::new(Some(&room_of(2, Some(&places()))), Settings::default());
    let (_, _, found) = service.get("/v1/query?text=1").await;
    let id = &found["results"][0]["answers"][0]["id"];
    assert!(id.as_str().is_some_and(|id| !id.starts_with('o')), "{found:#}");
    let body = service.ok("/v1/goal?text=1&near=2,3,0&step_m=0.15").await;
    is_as_described("/v1/goal", &body);
    assert_eq!((&body["thing"]["id"], body["none"].is_null()), (id, true), "{body:#}");
    let goal = &body["goals"][0];
    let at = |axis: usize| goal["position_in_world"][axis].as_f64().expect("a number");
    // The table's top is 1.6 by 0.9 m, from the origin.
    let distance = (at(0) - at(0).clamp(0.0, 1.6)).hypot(at(1) - at(1).clamp(0.0, 0.9));
    assert!((0.3..0.9).contains(&distance), "{body:#}");
    assert!(goal["visible_share"].as_f64() > Some(0.1), "{body:#}");
}

/// What a cell that could not be fetched may hold is unknown: every answer says so, found or not.
#[tokio::test]
async fn what_is_not_on_board_is_not_denied() {
    let service = Service::new(Some(&room_with(Some(&places()))), Settings::default());
    let cache = service.app.engine.cache();
    let mut current = cache.current().expect("reads").expect("there");
    current.bad_cells = vec![BadCell { cell_id: 9, fault: CellFault::Missing, old: None }];
    fs_err::write(cache.current_path(), serde_json::to_vec(&current).expect("JSON")).expect("writes");
    service.app.reload_now();
    let get = async |uri: &str| service.get(uri).await.2;
    for (uri, detail) in [
        ("/v1/query?text=largest+0&near=0,0,0&radius=3", None),
        ("/v1/query?text=largest+2&near=0,0,0&radius=3", Some("1 cell could not")),
        ("/v1/query?text=2", Some("1 cell could not")),
        ("/v1/objects?near=0,0,0&radius=3", None),
        ("/v1/goal?text=nearest+2&near=2,3,0&step_m=0.15", Some("1 cell could not")),
        ("/v1/goal?id=o00000000000000ff&near=2,3,0&step_m=0.15", Some("1 cell could not")),
    ] {
        let body = get(uri).await;
        is_as_described(uri.split('?').next().unwrap_or_default(), &body);
        let of = body["results"].get(0).unwrap_or(&body);
        let said = of["none"]["detail"].as_str();
        assert_eq!(said.is_some(), detail.is_some(), "{uri}: {body:#}");
        assert!(said.zip(detail).is_none_or(|(said, part)| said.contains(part)), "{uri}: {body:#}");
        if !uri.contains("goal") {
            assert_eq!(of["bad_cells"][0]["cell_id"], 9, "{uri}: {body:#}");
            assert_eq!(of["area_fetched"], false, "{uri}: {body:#}");
        }
    }
}

/// By hand: 6 by 5 m of seen floor in cells of 0.1 m, the table and the floor's mug in it.
#[tokio::test]
async fn the_floor_is_mapped() {
    let shards = room_with(Some(&places()));
    let service = Service::new(Some(&shards), Settings::default());
    let (_, _, body) = service.get("/v1/floor?near=2,3,0&step_m=0.15&range_m=6&radius_m=0.2").await;
    is_as_described("/v1/floor", &body);
    let runs = body["runs"].as_str().expect("text");
    let mut n = std::collections::BTreeMap::<char, usize>::new();
    let mut rest = runs;
    while let Some(kind) = rest.chars().next() {
        let end = rest[1..].find(|c: char| !c.is_ascii_digit()).map_or(rest.len(), |end| end + 1);
        *n.entry(kind).or_default() += rest[1..end].parse::<usize>().expect("a count");
        rest = &rest[end..];
    }
    let size: Vec<usize> = serde_json::from_value(body["size"].clone()).expect("two");
    assert_eq!(n.values().sum::<usize>(), size[0] * size[1]);
    let seen = n.iter().filter(|(kind, _)| **kind != 'u').map(|(_, n)| n).sum::<usize>();
    assert_eq!(seen, 60 * 50, "{n:?}");
    // The edge of the table's 16 x 9 cells, and the mug on it; the mug on the floor is as high as a step. The table's
    // top is unreachable ground.
    assert_eq!(n[&'o'], 47, "{n:?}");
    assert!(n[&'r'] > 2000 && n[&'g'] > 16 * 9 - 47, "{n:?}");
}

#[tokio::test]
async fn scenes_without_places_say_so() {
    let service = Service::new(Some(&room_with(None)), Settings::default());
    for path in ["/v1/goal?text=0&near=2,3,0&step_m=0.15", "/v1/floor"] {
        let (status, _, body) = service.get(path).await;
        assert_eq!(status, StatusCode::CONFLICT, "{body:#}");
        assert!(body["type"].as_str().is_some_and(|kind| kind.ends_with("no-occupancy")), "{body:#}");
    }
}
