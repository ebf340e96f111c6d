//! The page's messages, decoded as the page does and compared with the other routes.

use std::path::PathBuf;

use glam::DAffine3;
use half::f16;
use slag_common::appearance::AppearanceColumns;
use slag_common::photo_poses::BuiltPhotoPoses;
use slag_common::{Gaussians, View, pinhole};

use super::*;

async fn bytes_of(service: &Service, uri: &str) -> (StatusCode, Vec<u8>) {
    let response = soon(service.send("GET", uri)).await;
    let status = response.status();
    (status, to_bytes(response.into_body(), 1 << 20).await.expect("a body").to_vec())
}

fn u32_at(bytes: &[u8], at: usize) -> usize {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes")) as usize
}

fn f32_at(bytes: &[u8], at: usize) -> f64 {
    f32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes")).into()
}

fn f16_at(bytes: &[u8], at: usize) -> f64 {
    f16::from_le_bytes([bytes[at], bytes[at + 1]]).to_f64()
}

/// Two cells: 20 Gaussians of axis 0 and 5 between the axes 0 and 1; then 7 of axis 1 and one in no view.
fn two_cells() -> [BuiltShard; 2] {
    let along = |n: u16, embedding: [f32; 3]| -> Vec<Member> {
        (0..n).map(|i| Member { steps: [i, 2 * i, 3], embedding: embedding.to_vec() }).collect()
    };
    let near = TestShard::new(vec![along(20, [1.0, 0.0, 0.0]), along(5, [0.6, 0.8, 0.0])]);
    let far = TestShard::new(vec![along(7, [0.0, 1.0, 0.0])]);
    let cell_id = near.cell_id + 1;
    let far =
        TestShard { cell_id, origin: DVec3::new(3.0, -8.0, 0.5), without_evidence: vec![[9, 9, 9]], ..far };
    [near.build(false), far.build(false)]
}

#[tokio::test]
async fn every_gaussian_has_its_score_and_its_place() {
    let service = Service::new(Some(&two_cells()), Settings::default());
    let (_, _, described) = service.get("/v1/view").await;
    let cells = described["cells"].as_array().expect("cells");
    assert_eq!((cells.len(), &described["n_gaussians"]), (2, &33.into()), "{described}");
    let (status, message) = bytes_of(&service, "/v1/view/scores?text=0").await;
    assert_eq!((status, &message[..4]), (StatusCode::OK, b"SLGS".as_slice()));
    assert_eq!((u32_at(&message, 4), u32_at(&message, 16), u32_at(&message, 20)), (1, 2, 1));
    let (least, largest) = (f32_at(&message, 8), f32_at(&message, 12));
    let levels = &message[24 + 2 * 8..];
    assert_eq!(levels.len(), 33);
    let (_, _, old) = service.get("/query?text=0&kind=gaussians&limit=100&precision=centroids").await;
    let old = old["answers"].as_array().expect("answers");
    let (mut first, mut n_compared) = (0, 0);
    for (at, cell) in cells.iter().enumerate() {
        let (cell_id, n_gaussians) = (u32_at(&message, 24 + 8 * at), u32_at(&message, 28 + 8 * at));
        assert_eq!((&cell["cell"], &cell["n_gaussians"]), (&cell_id.into(), &n_gaussians.into()));
        assert_eq!(cell["state"], "on_board");
        let (status, gaussians) = bytes_of(&service, &format!("/v1/view/cells/{cell_id}?generation=1")).await;
        assert_eq!((status, &gaussians[..4]), (StatusCode::OK, b"SLGG".as_slice()));
        assert_eq!((u32_at(&gaussians, 8), u32_at(&gaussians, 24)), (n_gaussians, 0));
        assert_eq!(gaussians.len(), 32 + 16 * n_gaussians);
        for index in 0..n_gaussians {
            let id = format!("{cell_id}-{index}");
            let is_it = |answer: &&Value| answer["cell_id"] == cell_id && answer["index"] == index;
            let Some(answer) = old.iter().find(is_it) else { continue };
            n_compared += 1;
            let score = least + f64::from(levels[first + index]) / 255.0 * (largest - least);
            let expected = answer["score"].as_f64().expect("a score");
            assert!((score - expected).abs() <= 0.0021 * (largest - least), "{id}: {score}");
            for axis in 0..3 {
                let place = f32_at(&gaussians, 12 + 4 * axis) + f16_at(&gaussians, 32 + 6 * index + 2 * axis);
                let expected = answer["position_in_world"][axis].as_f64().expect("a number");
                assert!((place - expected).abs() < 1e-3, "{id}: {place} {expected}");
            }
        }
        first += n_gaussians;
    }
    assert_eq!((first, n_compared), (33, old.len()));
    assert!(n_compared >= 20, "{n_compared}");
    assert!(levels[..20].iter().all(|level| *level == 255) && levels[25..32].iter().all(|level| *level == 1));
    assert_eq!(levels[32], 0, "no view shows it");
}

#[tokio::test]
async fn appearances_on_board_are_handed_on() {
    let [near, _] = two_cells();
    let scene = Gaussians {
        scales: (0..25).map(|i| [0.01 * (1 + i) as f32; 3]).collect(),
        sh_dc: vec![[1.0, 0.0, -1.0]; 25],
        ..Gaussians::balls(vec![DVec3::ZERO; 25], 0.0)
    };
    let columns = AppearanceColumns::of(&scene, &(0..25).collect::<Vec<u32>>());
    let dressed = near.with(Additions { appearance: Some(columns.view()), ..Additions::default() });
    let service = Service::new(Some(&[dressed]), Settings::default());
    let (_, gaussians) = bytes_of(&service, "/v1/view/cells/1").await;
    assert_eq!(u32_at(&gaussians, 24), 1);
    // Colours of 0.5 +- 0.282 and opacities of 0.5, by hand.
    assert_eq!(gaussians[32 + 6 * 25..][..3], [199, 128, 56]);
    assert!(gaussians[32 + 9 * 25..32 + 10 * 25].iter().all(|opacity| *opacity == 128));
    let sizes: Vec<u8> = gaussians[32 + 10 * 25..32 + 13 * 25].chunks(3).map(|of| of[0]).collect();
    assert!(sizes.is_sorted() && sizes[0] < sizes[24]);
    // Every eighth Gaussian, unchanged but for its size.
    let (_, few) = bytes_of(&service, "/v1/view/cells/1?generation=1&step=8").await;
    assert_eq!((u32_at(&few, 8), u32_at(&few, 28), few.len()), (4, 8, 32 + 16 * 4));
    for (at, of) in [0, 8, 16, 24].into_iter().enumerate() {
        for axis in 0..3 {
            let place = |message: &[u8], at: usize| {
                f32_at(message, 12 + 4 * axis) + f16_at(message, 32 + 6 * at + 2 * axis)
            };
            assert!((place(&few, at) - place(&gaussians, of)).abs() < 1e-3);
        }
        assert_eq!(few[32 + 6 * 4 + 3 * at..][..3], gaussians[32 + 6 * 25 + 3 * of..][..3]);
        assert_eq!(few[32 + 13 * 4 + 3 * at..][..3], gaussians[32 + 13 * 25 + 3 * of..][..3]);
        assert!(few[32 + 10 * 4 + 3 * at] > gaussians[32 + 10 * 25 + 3 * of]);
    }
}

#[tokio::test]
async fn negatives_turn_scores_into_relevancies() {
    let service = Service::new(Some(&two_cells()), Settings::default());
    let (status, message) = bytes_of(&service, "/v1/view/scores?text=0&negative=1").await;
    assert_eq!(status, StatusCode::OK);
    assert!(f32_at(&message, 8) < 0.01 && f32_at(&message, 12) > 0.99);
}

#[tokio::test]
async fn wrong_requests_are_refused() {
    let service = Service::with_chair();
    let bad = "scores scores?text= scores?text=0&limit=1 cells/x cells/1?generation=x cells/1?step=0 \
        cells/1?generation=1&step=65537";
    for (expected, uris) in
        [(400, bad), (422, "scores?text=sofa"), (404, "cells/1?generation=2 cells/4294967295")]
    {
        for uri in uris.split(' ') {
            let (status, _, body) = service.get(&format!("/v1/view/{uri}")).await;
            assert_eq!(status, expected, "{uri}: {body}");
        }
    }
    let tiny = Service::new(Some(&chair(None)), Settings { query_bytes: 40, ..Settings::default() });
    for uri in ["/v1/view/scores?text=0", "/v1/view/cells/1"] {
        assert_eq!(tiny.get(uri).await.0, StatusCode::UNPROCESSABLE_ENTITY, "{uri}");
    }
    let empty = Service::new(None, Settings::default());
    for uri in ["/v1/view", "/v1/view/scores?text=0", "/v1/view/cells/1"] {
        assert_eq!(empty.get(uri).await.0, StatusCode::SERVICE_UNAVAILABLE, "{uri}");
    }
}

#[tokio::test]
async fn photo_poses_on_board_are_handed_on() {
    let [near, _] = two_cells();
    let (x, z) = (near.view().header.origin_in_world[0], near.view().header.origin_in_world[2]);
    let view = View {
        name: "a.jpg".into(),
        image_path: PathBuf::new(),
        intrinsics: pinhole([64, 48], 50.0),
        camera_from_world: DAffine3::from_translation(DVec3::new(-2.0, 0.0, 1.5)),
    };
    let mut photos = BuiltPhotoPoses::default();
    photos.push(DVec3::new(x, 0.0, z), &view);
    let shard = near.with(Additions { photo_poses: photos.view(), ..Additions::default() });
    let service = Service::new(Some(&[shard]), Settings::default());
    let (_, _, described) = service.get("/v1/view").await;
    let [photo] = &described["views"].as_array().expect("photos")[..] else { panic!("one: {described}") };
    let y = near.view().header.origin_in_world[1];
    assert_eq!(photo["position_m"], serde_json::json!([2.0, y, -1.5]));
    assert_eq!((&photo["name"], &photo["has_picture"]), (&"a.jpg".into(), &false.into()));
}
