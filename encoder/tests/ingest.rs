//! Photos: sizes, undistortion, geo-reference.

use super::*;

use slag_common::photo::PhotoError;
use slag_common::{Intrinsics, pinhole};
use slag_encoder::ingest::{
    GeoError, IngestError, OddPhotos, Oddity, check_memory, missing_images, read_geo_reference,
};

fn camera(distortion: Distortion) -> Intrinsics {
    let camera = pinhole([160, 120], 100.0);
    Intrinsics { focal_y_px: 105.0, centre_x_px: 82.0, centre_y_px: 57.0, distortion, ..camera }
}

fn view(path: &Path, intrinsics: Intrinsics) -> View {
    View { name: "a.png".into(), image_path: path.into(), intrinsics, camera_from_world: DAffine3::IDENTITY }
}

/// A smooth pattern of the undistorted image; argument in pixels.
fn pattern([u, v]: [f64; 2]) -> [f64; 3] {
    [128.0 + 100.0 * (u / 9.0).sin(), 128.0 + 100.0 * (v / 11.0).cos(), 128.0 + 0.5 * (u - v)]
}

/// Oracle of the tests below: inverts a distortion by Newton's method with a numeric derivative.
fn invert(distortion: Distortion, [x, y]: [f64; 2]) -> [f64; 2] {
    let mut ideal = [x, y];
    for _ in 0..50 {
        let h = 1e-6;
        let at = distortion.distort(ideal);
        let [dx, dy] = [[h, 0.0], [0.0, h]].map(|[a, b]| {
            let moved = distortion.distort([ideal[0] + a, ideal[1] + b]);
            [(moved[0] - at[0]) / h, (moved[1] - at[1]) / h]
        });
        let (ex, ey) = (x - at[0], y - at[1]);
        let determinant = dx[0] * dy[1] - dy[0] * dx[1];
        ideal[0] += (ex * dy[1] - ey * dy[0]) / determinant;
        ideal[1] += (ey * dx[0] - ex * dx[1]) / determinant;
    }
    ideal
}

fn photograph(camera: &Intrinsics) -> RgbImage {
    RgbImage::from_fn(camera.width_px, camera.height_px, |x, y| {
        let distorted = camera.distorted_from_pixel([f64::from(x) + 0.5, f64::from(y) + 0.5]);
        let ideal = invert(camera.distortion, distorted);
        Rgb(pattern(camera.pixel_from_distorted(ideal)).map(|c| c.round().clamp(0.0, 255.0) as u8))
    })
}

const LENSES: [Distortion; 3] = [
    Distortion::Brown { k: [-0.12, 0.02, 0.0], p: [0.003, -0.002] },
    Distortion::Brown { k: [0.15, 0.03, 0.01], p: [0.0, 0.0] },
    Distortion::Fisheye { k: [0.02, -0.01, 0.003, 0.0] },
];

#[test]
fn a_photo_through_a_lens_becomes_the_ideal_one() {
    let dir = tempfile::tempdir().unwrap();
    for distortion in LENSES {
        let camera = camera(distortion);
        let path = dir.path().join("a.png");
        photograph(&camera).save(&path).unwrap();
        let loaded = load_image(&view(&path, camera)).unwrap();
        assert_eq!(loaded.view.intrinsics, camera.without_distortion());
        let valid = loaded.valid.as_ref().unwrap();
        let (mut n_valid, mut largest, mut displaced) = (0, 0.0_f64, 0.0_f64);
        for (x, y, pixel) in loaded.image.enumerate_pixels() {
            let ideal_px = [f64::from(x) + 0.5, f64::from(y) + 0.5];
            let at = camera.pixel_from_distorted(camera.distort(camera.distorted_from_pixel(ideal_px)));
            let inside = (0.0..160.0).contains(&at[0]) && (0.0..120.0).contains(&at[1]);
            assert_eq!(valid[(y * 160 + x) as usize], inside, "{distortion:?} {x} {y}");
            if !inside {
                assert_eq!(pixel.0, [0; 3]);
                continue;
            }
            displaced = displaced.max((at[0] - ideal_px[0]).hypot(at[1] - ideal_px[1]));
            // The outermost half pixel repeats the edge.
            if (0.5..159.5).contains(&at[0]) && (0.5..119.5).contains(&at[1]) {
                n_valid += 1;
                let expected = pattern(ideal_px);
                (0..3).for_each(|c| largest = largest.max((expected[c] - f64::from(pixel.0[c])).abs()));
            }
        }
        // Two roundings to 8 bits, and a chord of the pattern's curvature 100 / 81 over a pixel that the lens may
        // stretch (1.4 times at most here).
        assert!(largest < 1.3, "{distortion:?}: off by {largest}");
        assert!(displaced > 3.0 && n_valid > 14_000, "{distortion:?}: too little, {displaced} {n_valid}");
    }
}

#[test]
fn labels_are_those_of_the_nearest_pixel() {
    for distortion in LENSES {
        let camera = camera(distortion);
        let labels: Vec<u32> = (0..160 * 120).collect();
        let ideal = Undistorter::new(camera).labels(&labels, u32::MAX);
        let (mut n, mut sum_px) = (0.0, [0.0; 2]);
        for (label, at) in ideal.iter().zip(0_u32..).filter(|(label, _)| **label != u32::MAX) {
            let found = [*label % 160, *label / 160].map(|v| f64::from(v) + 0.5);
            let ideal_px =
                camera.pixel_from_distorted(invert(distortion, camera.distorted_from_pixel(found)));
            let expected_px = [at % 160, at / 160].map(|v| f64::from(v) + 0.5);
            let off_px = [0, 1].map(|axis| ideal_px[axis] - expected_px[axis]);
            // Half a pixel each way, nearly doubled in the fisheye's corners.
            assert!(off_px.iter().all(|off| off.abs() < 1.0), "{distortion:?} {at}: {off_px:?}");
            n += 1.0;
            sum_px = [sum_px[0] + off_px[0], sum_px[1] + off_px[1]];
        }
        assert!(sum_px.iter().all(|sum| (sum / n).abs() < 0.02), "{distortion:?}: {sum_px:?} / {n}");
    }
}

/// Pixels beyond the fold of a strong barrel lens are invalid, although the formula maps them into the image.
#[test]
fn folded_pixels_are_not_valid() {
    let camera = Intrinsics {
        focal_x_px: 40.0,
        focal_y_px: 40.0,
        ..camera(Distortion::Brown { k: [-0.3, 0.0, 0.0], p: [0.0; 2] })
    };
    let (_, valid) = Undistorter::new(camera).image(&RgbImage::from_pixel(160, 120, Rgb([9; 3])));
    let fold = (1.0_f64 / 0.9).sqrt();
    let radius = |at: usize| {
        let [x, y] = camera.distorted_from_pixel([(at % 160) as f64 + 0.5, (at / 160) as f64 + 0.5]);
        x.hypot(y)
    };
    assert!(valid.iter().enumerate().all(|(at, valid)| !valid || radius(at) <= fold));
    let folded_back_inside = (0..valid.len()).filter(|at| (fold..1.7).contains(&radius(*at))).count();
    assert!(folded_back_inside > 1_000);
}

#[needs_shared]
fn a_pinhole_passes_bit_for_bit() {
    let scene = shared("scenes/house_a");
    let set = poses::read(&scene, None).unwrap();
    let loaded = load_image(&set.views[0]).unwrap();
    assert_eq!(loaded.view, set.views[0]);
    assert!(loaded.undistorter.is_none() && loaded.valid.is_none());
    assert_eq!(loaded.image, image::open(&set.views[0].image_path).unwrap().into_rgb8());
}

#[test]
fn sizes_that_are_a_scale_bring_the_camera_along() {
    let dir = tempfile::tempdir().unwrap();
    let odd = Intrinsics { width_px: 161, height_px: 121, ..camera(Distortion::None) };
    let load = |width: u32, height: u32, ending: &str, camera: Intrinsics| {
        let path = dir.path().join("a").with_extension(ending);
        RgbImage::new(width, height).save(&path).unwrap();
        load_image(&view(&path, camera))
    };
    for (width, height, ending) in [(80, 60, "png"), (40, 30, "webp"), (320, 240, "jpg"), (120, 90, "png")] {
        let scaled = load(width, height, ending, camera(Distortion::None)).unwrap().view.intrinsics;
        let scale = f64::from(width) / 160.0;
        assert_eq!((scaled.width_px, scaled.height_px), (width, height));
        assert_eq!([scaled.focal_x_px, scaled.focal_y_px], [100.0 * scale, 105.0 * scale]);
        assert_eq!([scaled.centre_x_px, scaled.centre_y_px], [82.0 * scale, 57.0 * scale]);
    }
    assert!(load(80, 60, "png", odd).is_ok(), "halved and rounded down");
    assert!(load(81, 61, "png", odd).is_ok(), "halved and rounded up");
    for (width, height) in [(160, 121), (159, 120), (120, 160), (81, 60), (80, 59), (1440, 1080)] {
        match load(width, height, "png", camera(Distortion::None)) {
            Err(error @ IngestError::Size { found_px, expected_px, .. }) => {
                assert_eq!((found_px, expected_px), ([width, height], [160, 120]));
                let is_swapped = (width, height) == (120, 160);
                assert_eq!(error.to_string().contains("sides swapped; swap"), is_swapped, "{error}");
            }
            other => panic!("{width} x {height}: {:?}", other.map(|loaded| loaded.view)),
        }
    }
}

/// APP1: big-endian TIFF with one entry, tag 0x0112 (orientation), a 16-bit 6 (rotated by 90 degrees).
const EXIF: &[u8] =
    b"\xFF\xE1\x00\x22Exif\0\0MM\0\x2A\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";

/// A coefficient of another lens: little but the photo's middle is left, and it is told.
#[test]
fn lens_models_that_leave_little_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    RgbImage::from_pixel(160, 120, Rgb([90; 3])).save(&path).unwrap();
    for (k1, expected) in [(-0.1, None), (-20.0, Some(Oddity::Narrowed))] {
        let lens = Distortion::Brown { k: [k1, 0.0, 0.0], p: [0.0; 2] };
        assert_eq!(load_image(&view(&path, camera(lens))).unwrap().oddity, expected, "{k1}");
    }
}

/// EXIF orientation is ignored, because COLMAP reads pixels as they are stored.
#[test]
fn exif_orientation_is_ignored() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.jpg");
    RgbImage::from_fn(160, 120, |x, _| Rgb([x as u8; 3])).save(&path).unwrap();
    let plain = load_image(&view(&path, camera(Distortion::None))).unwrap().image;
    let jpeg = fs_err::read(&path).unwrap();
    fs_err::write(&path, [&jpeg[..2], EXIF, &jpeg[2..]].concat()).unwrap();
    let rotated = load_image(&view(&path, camera(Distortion::None))).unwrap();
    assert!(rotated.image == plain && rotated.oddity == Some(Oddity::Rotated));
    // Two thousand of them give one line.
    let photos = OddPhotos::default();
    assert!(photos.lines().is_empty());
    (0..2000).for_each(|_| photos.add(&rotated));
    let [line] = &photos.lines()[..] else { panic!("one line") };
    assert!(line.starts_with("2000 photos have an EXIF orientation") && line.len() < 250, "{line}");
}

#[test]
fn absent_and_damaged_images_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    let absent = view(&dir.path().join("b.png"), camera(Distortion::None));
    let damaged = view(&path, camera(Distortion::None));
    RgbImage::from_fn(160, 120, |x, y| Rgb([(x * y) as u8, x as u8, y as u8])).save(&path).unwrap();
    let bytes = fs_err::read(&path).unwrap();
    fs_err::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    assert!(matches!(load_image(&absent), Err(IngestError::Io(e)) if e.to_string().contains("b.png")));
    assert!(matches!(load_image(&damaged), Err(IngestError::Photo { path, .. }) if path.ends_with("a.png")));
    let views = [damaged, absent.clone()];
    assert_eq!(missing_images(&views), [&absent]);

    // A truncated JPEG, and more pixels than memory.
    let mut random = slag_math::random::Random::new(3);
    let path = dir.path().join("c.jpg");
    RgbImage::from_fn(160, 120, |_, _| Rgb([random.bits() as u8; 3])).save(&path).unwrap();
    let photo = view(&path, camera(Distortion::None));
    load_image(&photo).expect("whole");
    let bytes = fs_err::read(&path).unwrap();
    let middle = bytes.len() / 2;
    fs_err::write(&path, &bytes[..middle]).unwrap();
    assert!(matches!(load_image(&photo), Err(IngestError::Photo { fault: PhotoError::Cut, .. })));
    let zeros = [&bytes[..middle], &[0; 300], &bytes[middle + 300..]].concat();
    fs_err::write(&path, zeros).unwrap();
    assert!(matches!(load_image(&photo), Err(IngestError::Photo { fault: PhotoError::Zeros, .. })));
    assert_error(check_memory(&photo, 160 * 120), &["c.jpg", "160 x 120 px"]);
    check_memory(&photo, 1 << 20).expect("enough");
}

/// Drawings are recognised whatever byte order mark the text has.
#[test]
fn drawings_are_told_by_a_text_of_windows() {
    let dir = tempfile::tempdir().unwrap();
    for mark in ["", "\u{feff}"] {
        fs_err::write(dir.path().join("transforms.json"), format!(r#"{mark}{{"drawn_from": "a.ply"}}"#))
            .unwrap();
        assert_eq!(drawn_from(dir.path()), Some("a.ply".to_owned()), "{mark:?}");
    }
}

#[needs_shared]
fn geo_reference() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("geo.json");
    let read = |json: &str| {
        fs_err::write(&path, json).unwrap();
        read_geo_reference(&path)
    };
    let refused = |json: &str| read(json).unwrap_err().to_string();
    let origin =
        read(r#"{"origin": {"lat": -90, "lon": 180, "alt": -3.5, "x": 1}, "more": []}"#).unwrap().origin;
    assert_eq!((origin.latitude_deg, origin.longitude_deg, origin.height_m), (-90.0, 180.0, -3.5));
    for (json, name) in [
        (r#"{"origin": {"lat": 91, "lon": 0, "alt": 0}}"#, "lat"),
        (r#"{"origin": {"lat": 0, "lon": -180.01, "alt": 0}}"#, "lon"),
        (r#"{"origin": {"lat": 0, "lon": 0, "alt": 1e6}}"#, "alt"),
    ] {
        assert!(refused(json).contains(&format!("origin.{name} = ")), "{json}");
    }
    for json in [
        "",
        "[]",
        r#"{"origin": {"lat": 0, "lon": 0}}"#,
        r#"{"origin": {"lat": NaN, "lon": 0, "alt": 0}}"#,
        // Arrays are refused: GeoJSON's order differs from ours.
        r#"{"origin": [8.54, 47.37, 400]}"#,
        r#"[{"lat": 1, "lon": 2, "alt": 3}]"#,
    ] {
        assert!(refused(json).contains("expected {\"origin\""), "{json}");
    }
    let utf16: Vec<u8> = "{}".encode_utf16().flat_map(u16::to_le_bytes).collect();
    fs_err::write(&path, utf16).unwrap();
    assert_error(read_geo_reference(&path), &["UTF-8"]);
    assert!(read("\u{feff}{\"origin\": {\"lat\": 1, \"lon\": 2, \"alt\": 3}}").is_ok(), "a byte order mark");
    let twice = read(r#"{"origin": {"lat": 8, "lat": 47, "lon": 8, "alt": 0}}"#).unwrap_err().to_string();
    assert!(twice.contains("duplicate field `lat`"), "{twice}");
    // Endless, but no more than a limit is read.
    assert!(matches!(read_geo_reference("/dev/zero".as_ref()), Err(GeoError::File { .. })));
    let brighton = shared("scenes/brighton/geo.json");
    let origin = read_geo_reference(&brighton).unwrap().origin;
    let found = (origin.latitude_deg, origin.longitude_deg, origin.height_m);
    assert_eq!(found, (46.842657, -91.994008, 158.509));
}

/// Oracle: numeric derivatives. Strong tangential terms fold the image, and folded pixels have no image; lenses of
/// real cameras do not fold.
#[test]
fn pixels_where_a_lens_folds_have_no_image() {
    for (p, folds) in [([0.4, -0.3], true), ([0.003, -0.002], false)] {
        let distortion = Distortion::Brown { k: [0.0; 3], p };
        let lens = camera(distortion);
        let photo = RgbImage::from_pixel(lens.width_px, lens.height_px, Rgb([9; 3]));
        let (_, valid) = Undistorter::new(lens).image(&photo);
        let mut n_folded = 0;
        for (at, valid) in valid.into_iter().enumerate() {
            let pixel = [at % lens.width_px as usize, at / lens.width_px as usize].map(|c| c as f64 + 0.5);
            let [x, y] = lens.distorted_from_pixel(pixel);
            let h = 1e-6;
            let at = |dx: f64, dy: f64| distortion.distort([x + dx, y + dy]);
            let slope = |a: [f64; 2], b: [f64; 2]| [0, 1].map(|i| (a[i] - b[i]) / (2.0 * h));
            let ([a, b], [c, d]) = (slope(at(h, 0.0), at(-h, 0.0)), slope(at(0.0, h), at(0.0, -h)));
            let is_folded = a * d - b * c <= 0.0;
            n_folded += usize::from(is_folded);
            assert!(!(is_folded && valid), "{pixel:?}");
        }
        assert_eq!(n_folded > 100, folds, "{n_folded}");
    }
}

/// EXIF orientation is applied only if the turned photo alone fits its camera; transparent pixels are outside.
#[test]
fn turned_and_transparent_photos() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    let camera = camera(Distortion::None);
    let mut photo = image::RgbaImage::from_pixel(160, 120, image::Rgba([10, 20, 30, 255]));
    photo.put_pixel(7, 3, image::Rgba([200, 200, 200, 0]));
    photo.save(&path).unwrap();
    let loaded = load_image(&view(&path, camera)).unwrap();
    let valid = loaded.valid.expect("some are hidden");
    assert_eq!(valid.iter().position(|valid| !valid), Some(3 * 160 + 7));
    assert_eq!((valid.iter().filter(|valid| !**valid).count(), loaded.image.get_pixel(7, 3).0), (1, [0; 3]));

    // Stored upright with orientation 6: a clockwise quarter turn moves its right column to the bottom.
    let upright = RgbImage::from_fn(120, 160, |x, _| Rgb([if x == 119 { 250 } else { 5 }; 3]));
    let mut jpeg = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 95).encode_image(&upright).unwrap();
    let path = dir.path().join("b.jpg");
    fs_err::write(&path, [&jpeg[..2], EXIF, &jpeg[2..]].concat()).unwrap();
    let loaded = load_image(&view(&path, camera)).unwrap();
    assert_eq!(loaded.image.dimensions(), (160, 120));
    assert!(loaded.image.get_pixel(80, 119)[0] > 150 && loaded.image.get_pixel(80, 60)[0] < 60);
    for brand in ["heic", "heim", "hevc", "msf1"] {
        fs_err::write(&path, format!("\0\0\0\x24ftyp{brand}\0\0\0\0mif1heic")).unwrap();
        let heif = load_image(&view(&path, camera));
        assert!(matches!(heif, Err(IngestError::Photo { fault: PhotoError::Heif, .. })), "{brand}");
    }
    fs_err::write(&path, b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n").unwrap();
    assert!(load_image(&view(&path, camera)).unwrap_err().to_string().contains("git lfs pull"));
}
