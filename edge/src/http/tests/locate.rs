//! `POST /v1/locate`.

use super::*;

async fn post(service: &Service, query: &str, kind: &str, photo: Vec<u8>) -> (StatusCode, Value) {
    let (status, headers, body) = service.post(&format!("/v1/locate?{query}"), kind, photo).await;
    let api = description();
    let replies = &api["paths"]["/v1/locate"]["post"]["responses"][status.as_str()]["content"];
    let kind = headers["content-type"].to_str().expect("text");
    assert_eq!(check(&replies[kind]["schema"], &body, ""), Ok(()), "{body:#}");
    (status, body)
}

pub(super) fn png(width: u32, height: u32) -> Vec<u8> {
    encoded(&image::RgbImage::new(width, height))
}

fn encoded(photo: &image::RgbImage) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    photo.write_to(&mut bytes, image::ImageFormat::Png).expect("memory");
    bytes.into_inner()
}

#[tokio::test]
async fn photos_are_lost_or_refused() {
    let service = Service::with_chair();
    let (status, body) = post(&service, "focal_px=500&gravity=0,1,0", "image/png", png(64, 48)).await;
    assert_eq!((status, &body["state"]), (StatusCode::OK, &json!("lost")), "{body:#}");
    assert!(body["reason"].as_str().is_some_and(|reason| reason.contains("--locate")), "{body:#}");
    for (query, parameter) in [
        ("", "focal_px"),
        ("focal_px=0", "focal_px"),
        ("focal_px=NaN", "focal_px"),
        ("focal_px=500&centre_px=1", "centre_px"),
        ("focal_px=500&centre_px=NaN,1", "centre_px"),
        ("focal_px=500&centre_px=65,1", "centre_px"),
        ("focal_px=500&gravity=0,0,0", "gravity"),
        ("focal_px=500&gravity=1e-170,0,0", "gravity"),
        ("focal_px=500&gravity=0,1e-7,0", "gravity"),
        ("focal_px=500&gravity=0,1e200,0", "gravity"),
        ("focal_px=500&near=1,2,3", "sigma"),
        ("focal_px=500&near=1,2,3&sigma=0", "sigma"),
        ("focal_px=500&sigma=1", "near"),
        ("focal_px=500&near_lat_lon=46,8&sigma=1", "near_lat_lon"),
    ] {
        let (status, body) = post(&service, query, "image/jpeg", png(64, 48)).await;
        assert_eq!((status, &body["parameter"]), (StatusCode::BAD_REQUEST, &json!(parameter)), "{query}");
    }
    for (bytes, expected) in [("hello", "WebP"), ("<!DOCTYPE html>", "web page")] {
        let (status, body) = post(&service, "focal_px=500", "image/png", bytes.into()).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{body:#}");
        assert!(body["detail"].as_str().is_some_and(|detail| detail.contains(expected)), "{body:#}");
    }
    let mut webp = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(64, 48).write_to(&mut webp, image::ImageFormat::WebP).expect("memory");
    let (status, body) = post(&service, "focal_px=500", "image/webp", webp.into_inner()).await;
    assert_eq!((status, &body["state"]), (StatusCode::OK, &json!("lost")), "{body:#}");
    let refused = post(&service, "focal_px=500", "application/json", png(64, 48)).await;
    assert_eq!(refused.0, StatusCode::UNSUPPORTED_MEDIA_TYPE);
    let refused = post(&service, "focal_px=500", "image/png", vec![0; (32 << 20) + 1]).await;
    assert_eq!(refused.0, StatusCode::PAYLOAD_TOO_LARGE);
}

/// Noise does not compress: a file of a camera's length, 3 MB.
#[tokio::test]
async fn long_photos_are_taken() {
    let mut random = slag_math::random::Random::new(3);
    let noise = encoded(&image::RgbImage::from_fn(1000, 1000, |_, _| {
        image::Rgb([(); 3].map(|()| random.bits() as u8))
    }));
    assert!(noise.len() > 2_900_000, "{}", noise.len());
    let (status, body) = post(&Service::with_chair(), "focal_px=500", "image/png", noise).await;
    assert_eq!((status, &body["state"]), (StatusCode::OK, &json!("lost")), "{body:#}");
}

/// A picture of one colour is short as a file: its memory is refused before it is read.
#[tokio::test]
async fn memory_is_bounded() {
    let with =
        |query_bytes: u64| Service::new(Some(&chair(None)), Settings { query_bytes, ..Settings::default() });
    let service = with(20 << 20);
    let (status, body) = post(&service, "focal_px=500", "image/png", png(4000, 3000)).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body:#}");
    let (status, _) = post(&service, "focal_px=500", "image/png", png(64, 48)).await;
    assert_eq!(status, StatusCode::OK);
    // Data before the pixels may inflate: the file is not opened without memory for that.
    let (status, body) = post(&with(10 << 20), "focal_px=500", "image/png", b"no photo".to_vec()).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body:#}");
}
