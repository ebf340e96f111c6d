//! Damaged mask files: an error or a valid result, never a panic, and no allocation that the size
//! of file and image does not justify.

use glam::DAffine3;
use image::RgbImage;
use slag_common::View;
use slag_encoder::masks::Mask;
use slag_encoder::masks::rle::Rle;
use slag_encoder::raster::pinhole;
use slag_encoder::segment::{GivenMasks, SegmentError, SegmentInput};
use slag_math::random::Random;
use slag_test_support::{damaged, memory_of};

const WIDTH_PX: u32 = 64;
const HEIGHT_PX: u32 = 48;

fn check(masks: &[Mask]) {
    for mask in masks {
        assert!(mask.box_px.x0 < mask.box_px.x1 && mask.box_px.x1 <= WIDTH_PX);
        assert!(mask.box_px.y0 < mask.box_px.y1 && mask.box_px.y1 <= HEIGHT_PX);
        assert_eq!(mask.inside.len(), (mask.box_px.width_px() * mask.box_px.height_px()) as usize);
        assert_eq!(mask.inside.iter().filter(|inside| **inside).count(), mask.area_px as usize);
    }
}

fn view() -> View {
    View {
        name: "a.jpg".into(),
        image_path: "a.jpg".into(),
        intrinsics: pinhole([WIDTH_PX, HEIGHT_PX], 50.0),
        camera_from_world: DAffine3::IDENTITY,
    }
}

/// Reads 1,000 damaged versions of a mask file; both outcomes must occur.
fn survive(name: &str, bytes: &[u8], whole: bool) {
    let dir = tempfile::tempdir().unwrap();
    let view = view();
    let image = RgbImage::new(WIDTH_PX, HEIGHT_PX);
    let input =
        SegmentInput { view: &view, image: &image, valid: None, undistorter: None, depth: None, pool: None };
    let path = dir.path().join(name);
    let load = |bytes: &[u8]| {
        fs_err::write(&path, bytes).unwrap();
        GivenMasks::open(if whole { &path } else { dir.path() }, Vec::new())?.load(&input)
    };
    assert!(load(bytes).unwrap().is_some_and(|masks| masks.len() > 1));
    let mut random = Random::new(bytes.len() as u64);
    let (mut n_read, mut n_errors) = (0, 0);
    for round in 0..1_000 {
        let bad = damaged(bytes, &mut random);
        let (result, taken) = memory_of(|| load(&bad));
        // The table of 16-bit ids is the largest fixed part; JSON is buffered value by value.
        assert!(taken.largest_bytes <= (3 << 19) + 64 * bad.len(), "{name} {round}: {taken:?}");
        match result {
            Ok(masks) => {
                n_read += 1;
                check(&masks.unwrap_or_default());
            }
            Err(SegmentError::Io(error)) => panic!("{name} {round}: {error}"),
            Err(error) => {
                n_errors += 1;
                assert!(error.to_string().contains(name), "{error}");
            }
        }
    }
    assert!(n_read > 0 && n_errors > 200, "{name}: {n_read} read, {n_errors} errors");
}

#[test]
fn damaged_id_images() {
    let id = |x: u32, y: u32| (x / 9 + y / 7) as u16;
    let pixels = || (0..HEIGHT_PX).flat_map(|y| (0..WIDTH_PX).map(move |x| id(x, y)));
    for depth in [png::BitDepth::Eight, png::BitDepth::Sixteen] {
        let rows: Vec<u8> = match depth {
            png::BitDepth::Eight => pixels().map(|id| id as u8).collect(),
            _ => pixels().flat_map(|id| (id * 4_000).to_be_bytes()).collect(),
        };
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, WIDTH_PX, HEIGHT_PX);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(depth);
        encoder.write_header().unwrap().write_image_data(&rows).unwrap();
        survive("a.png", &file, false);
    }
}

/// A small file that unpacks to far more than the image has pixels is refused by its header.
#[test]
fn an_id_image_that_unpacks_to_much() {
    let dir = tempfile::tempdir().unwrap();
    image::GrayImage::new(6_000, 6_000).save(dir.path().join("a.png")).unwrap();
    let (view, image) = (view(), RgbImage::new(WIDTH_PX, HEIGHT_PX));
    let input =
        SegmentInput { view: &view, image: &image, valid: None, undistorter: None, depth: None, pool: None };
    let given = GivenMasks::open(dir.path(), Vec::new()).unwrap();
    let (loaded, taken) = memory_of(|| given.load(&input));
    let error = loaded.unwrap_err();
    assert!(matches!(error, SegmentError::Size { found_px: [6_000, 6_000], .. }), "{error}");
    assert!(taken.largest_bytes < 100_000, "{taken:?}");
}

#[test]
fn damaged_run_lengths() {
    let masks: Vec<Mask> = (1..6)
        .map(|i| {
            let runs = (0..WIDTH_PX).flat_map(|_| [HEIGHT_PX - 7 * i, 7 * i]).collect();
            Rle::from_counts(WIDTH_PX, HEIGHT_PX, runs).unwrap().to_mask().unwrap()
        })
        .collect();
    let text = |mask| Rle::from_mask(mask, WIDTH_PX, HEIGHT_PX).to_text();
    let mut annotations: Vec<_> = masks
        .iter()
        .map(|mask| serde_json::json!({"segmentation": {"size": [48, 64], "counts": text(mask)}, "image_id": 1}))
        .collect();
    annotations.push(
        serde_json::json!({"segmentation": {"size": [48, 64], "counts": [1000, 72, 2000]}, "image_id": 1}),
    );
    survive("a.json", serde_json::json!(annotations).to_string().as_bytes(), false);
    let data_set =
        serde_json::json!({"images": [{"id": 1, "file_name": "a.jpg"}], "annotations": annotations});
    survive("coco.json", data_set.to_string().as_bytes(), true);
}
