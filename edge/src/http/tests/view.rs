//! The messages of the page, read as a page reads them, and compared with the other routes.

use super::*;

async fn bytes_of(service: &Service, uri: &str) -> (StatusCode, Vec<u8>) {
    let response = soon(service.send("GET", uri)).await;
    let status = response.status();
    (status, to_bytes(response.into_body(), 1 << 20).await.expect("a body").to_vec())
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"))
}

fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"))
}

fn f64_at(bytes: &[u8], at: usize) -> f64 {
    f64::from_le_bytes(bytes[at..at + 8].try_into().expect("8 bytes"))
}

/// Two cells: 20 Gaussians of axis 0 and 5 between the axes 0 and 1; then 7 of axis 1.
fn two_cells() -> [BuiltShard; 2] {
    let along = |n: u16, embedding: [f32; 3]| -> Vec<Member> {
        (0..n).map(|i| Member { steps: [i, 2 * i, 3], embedding: embedding.to_vec() }).collect()
    };
    let near = TestShard::new(vec![along(20, [1.0, 0.0, 0.0]), along(5, [0.6, 0.8, 0.0])]);
    let far = TestShard::new(vec![along(7, [0.0, 1.0, 0.0])]);
    let far = TestShard { cell_id: near.cell_id + 1, origin: DVec3::new(3.0, -8.0, 0.5), ..far };
    [near.build(false), far.build(false)]
}

#[tokio::test]
async fn every_gaussian_has_its_score_and_its_position() {
    let service = Service::new(Some(&two_cells()), Settings::default());
    let (status, message) = bytes_of(&service, "/v1/view/scores?text=0").await;
    assert_eq!((status, &message[..8]), (StatusCode::OK, b"SLAGVSC1".as_slice()));
    assert_eq!((u32_at(&message, 8), u32_at(&message, 24)), (1, 2), "generation and cells");
    let (least, largest) = (f32_at(&message, 16), f32_at(&message, 20));
    let levels = &message[32 + 2 * 8..];
    assert_eq!(levels.len(), 32);
    let (_, _, old) = service.get("/query?text=0&kind=gaussians&limit=100&precision=centroids").await;
    let old = old["answers"].as_array().expect("answers");
    let (mut first, mut n_compared) = (0, 0);
    for cell in 0..2 {
        let (cell_id, n_gaussians) =
            (u32_at(&message, 32 + 8 * cell), u32_at(&message, 36 + 8 * cell) as usize);
        let (status, positions) = bytes_of(&service, &format!("/v1/view/cells/{cell_id}")).await;
        assert_eq!((status, &positions[..8]), (StatusCode::OK, b"SLAGVPO1".as_slice()));
        assert_eq!((u32_at(&positions, 16), u32_at(&positions, 20) as usize), (cell_id, n_gaussians));
        assert_eq!(positions.len(), 48 + 12 * n_gaussians);
        for index in 0..n_gaussians {
            let id = format!("{cell_id}-{index}");
            let Some(answer) = old.iter().find(|answer| answer["id"] == id.as_str()) else { continue };
            n_compared += 1;
            let score = least + f32::from(levels[first + index] - 1) / 254.0 * (largest - least);
            let expected = answer["score"].as_f64().expect("a score");
            assert!(
                (f64::from(score) - expected).abs() <= 0.002 * f64::from(largest - least),
                "{id}: {score}"
            );
            for axis in 0..3 {
                let offset = f32_at(&positions, 48 + 12 * index + 4 * axis);
                let expected = answer["position_in_world"][axis].as_f64().expect("a number");
                assert!(
                    (f64_at(&positions, 24 + 8 * axis) + f64::from(offset) - expected).abs() < 1e-5,
                    "{id}"
                );
            }
        }
        first += n_gaussians;
    }
    assert_eq!((first, n_compared), (32, old.len()));
    assert!(n_compared >= 20, "{n_compared}");
    assert!(levels[..20].iter().all(|level| *level == 255) && levels[25..].iter().all(|level| *level == 1));
}

#[tokio::test]
async fn negatives_turn_scores_into_relevancies() {
    let service = Service::new(Some(&two_cells()), Settings::default());
    let (status, message) = bytes_of(&service, "/v1/view/scores?text=0&negative=1").await;
    assert_eq!(status, StatusCode::OK);
    let expected = crate::score::relevancy(-1.0)..=crate::score::relevancy(1.0) + 1e-3;
    let (least, largest) = (f32_at(&message, 16), f32_at(&message, 20));
    assert!(least < 0.01 && largest > 0.99 && expected.contains(&largest), "{least} {largest}");
}

#[tokio::test]
async fn wrong_requests_are_refused() {
    let service = Service::with_chair();
    for (uri, expected) in [
        ("/v1/view/scores", StatusCode::BAD_REQUEST),
        ("/v1/view/scores?text=", StatusCode::BAD_REQUEST),
        ("/v1/view/scores?text=0&limit=1", StatusCode::BAD_REQUEST),
        ("/v1/view/scores?text=sofa", StatusCode::UNPROCESSABLE_ENTITY),
        ("/v1/view/cells/x", StatusCode::BAD_REQUEST),
        ("/v1/view/cells/4294967295", StatusCode::NOT_FOUND),
    ] {
        let (status, _, body) = service.get(uri).await;
        assert_eq!(status, expected, "{uri}: {body}");
    }
    let empty = Service::new(None, Settings::default());
    for uri in ["/v1/view/scores?text=0", "/v1/view/cells/1"] {
        assert_eq!(empty.get(uri).await.0, StatusCode::SERVICE_UNAVAILABLE, "{uri}");
    }
}
