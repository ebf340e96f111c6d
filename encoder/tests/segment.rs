//! Masks: run lengths, users' files, the partition into regions.

use super::*;

use image::GrayImage;
use proptest::prelude::*;
use slag_encoder::masks::regions::{absorb_slivers, partition};
use slag_encoder::masks::rle::{Rle, RleError};
use slag_encoder::masks::{NO_REGION, RegionMap};
use slag_encoder::segment::SegmentError;

/// `None` if no pixel is inside.
fn mask(width: u32, height: u32, inside: impl Fn(u32, u32) -> bool) -> Option<Mask> {
    let pixels: Vec<(u32, u32)> =
        (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).filter(|(x, y)| inside(*x, *y)).collect();
    let box_px = BoxPx {
        x0: pixels.iter().map(|p| p.0).min()?,
        y0: pixels.iter().map(|p| p.1).min()?,
        x1: pixels.iter().map(|p| p.0).max()? + 1,
        y1: pixels.iter().map(|p| p.1).max()? + 1,
    };
    let inside = (box_px.y0..box_px.y1).flat_map(|y| (box_px.x0..box_px.x1).map(move |x| (x, y)));
    let inside = inside.map(|(x, y)| pixels.binary_search_by_key(&(y, x), |p| (p.1, p.0)).is_ok()).collect();
    Some(Mask { box_px, inside, area_px: pixels.len() as u32, level: 0 })
}

/// Oracle: pycocotools 2.0 (`mask.encode` of the same arrays), recorded.
#[test]
fn run_lengths_are_cocos() {
    let disc = mask(40, 30, |x, y| x.abs_diff(20).pow(2) + y.abs_diff(14).pow(2) <= 100);
    let foot = mask(40, 30, |x, y| (x, y) == (3, 29) || (x, y) == (4, 0));
    let full = mask(40, 30, |_, _| true);
    let rects = mask(400, 300, |x, y| {
        ((150..153).contains(&x) && y >= 6)
            || ((300..304).contains(&x) && (100..290).contains(&y))
            || (x == 399 && y < 2)
    });
    for (expected, size, text) in [
        (disc, (40, 30), "j91i08J4M2N2O0O2O00000O20N1000001N101N2N3L6HT8"),
        (full, (40, 30), "0`U1"),
        (None, (40, 30), "`U1"),
        (foot, (40, 30), "g32gQ1"),
        (rects, (400, 300), "^n[1V96000RU[1hLVndN00000`gk0TJ\\^TO"),
    ] {
        let rle = Rle::from_text(size.0, size.1, text).unwrap();
        assert_eq!(rle.to_mask(), expected, "{text}");
        assert_eq!(rle.box_px(), expected.map(|mask| mask.box_px));
    }
}

#[test]
fn bad_run_lengths_are_refused() {
    assert_eq!(Rle::from_counts(4, 3, vec![6, 5]), Err(RleError::Sum { expected: 12, found: 11 }));
    assert_eq!(Rle::from_text(40, 30, "`U1 "), Err(RleError::Digit { offset_bytes: 3 }));
    assert_eq!(Rle::from_text(40, 30, "`"), Err(RleError::Digit { offset_bytes: 0 }));
    assert_eq!(Rle::from_text(40, 30, "oooooooo0"), Err(RleError::Digit { offset_bytes: 7 }));
    assert_eq!(Rle::from_text(40, 30, "O"), Err(RleError::Run { index: 0 }));
    assert!(matches!(Rle::from_counts(65_536, 1, vec![65_536]), Err(RleError::Size { .. })));
    assert!(Rle::from_counts(0, 0, vec![]).unwrap().to_mask().is_none());
}

fn view(name: &str, width_px: u32, height_px: u32) -> View {
    let intrinsics = pinhole([width_px, height_px], 50.0);
    View { name: name.into(), image_path: "none".into(), intrinsics, camera_from_world: DAffine3::IDENTITY }
}
fn input<'a>(view: &'a View, image: &'a RgbImage) -> SegmentInput<'a> {
    SegmentInput { view, image, valid: None, undistorter: None, depth: None, pool: None }
}

/// Masks of image `left/a.jpg`, 8 x 6 pixels, from a folder.
fn load(dir: &Path, ignored: &[u32], lens: Option<&Undistorter>) -> Result<Option<Vec<Mask>>, SegmentError> {
    let (view, image) = (view("left/a.jpg", 8, 6), RgbImage::new(8, 6));
    let input = SegmentInput { undistorter: lens, ..input(&view, &image) };
    let given = GivenMasks::open(dir, ignored.to_vec())?;
    let loaded = given.load(&input);
    if let Ok(masks) = &loaded {
        assert_eq!(given.covers(&view), masks.is_some());
        assert_eq!(given.segment(&input).unwrap(), masks.clone().unwrap_or_default());
    }
    loaded
}

/// Given masks are identified by file contents, not by path, length or place.
#[test]
fn the_identity_of_given_masks_is_that_of_their_contents() {
    let of_view = |name: &str, path: &Path, ignored: &[u32]| {
        let given = GivenMasks::open(path, ignored.to_vec()).unwrap();
        (given.identity(), given.identity_of_view(&view(name, 8, 6)).unwrap())
    };
    let identity = |path: &Path, ignored: &[u32]| of_view("left/a.jpg", path, ignored);
    let (dir, other) = (folder(), folder());
    let png = |rows: &[u8]| {
        write_png(&dir.path().join("left/a.png"), png::ColorType::Grayscale, png::BitDepth::One, rows);
    };
    png(&[0b0011_1100; 6]);
    let before = identity(dir.path(), &[]);
    assert_eq!(identity(dir.path(), &[]), before);
    assert_ne!(identity(dir.path(), &[1]), before, "ignored ids");
    fs_err::copy(dir.path().join("left/a.png"), other.path().join("left/a.png")).unwrap();
    assert_eq!(identity(other.path(), &[]), before, "another place");
    fs_err::rename(other.path().join("left/a.png"), other.path().join("left/b.png")).unwrap();
    assert_ne!(identity(other.path(), &[]), before, "another view");
    assert_eq!(of_view("left/b.jpg", other.path(), &[]), before, "the view that has the file now");
    let len_bytes = fs_err::metadata(dir.path().join("left/a.png")).unwrap().len();
    png(&[0b0001_1110; 6]);
    assert_eq!(fs_err::metadata(dir.path().join("left/a.png")).unwrap().len(), len_bytes);
    assert_ne!(identity(dir.path(), &[]), before, "other pixels in a file of the same length");

    let data_set = dir.path().join("set.json");
    let write_with = |more: &str, runs: &str| {
        let text = format!(
            r#"{{"images":[{{"id":1,"file_name":"left/a.jpg"}},{{"id":2,"file_name":"b"}}],"annotations":[{more}{{"image_id":1,"segmentation":{{"size":[6,8],"counts":[{runs}]}}}}]}}"#
        );
        fs_err::write(&data_set, text).unwrap();
        identity(&data_set, &[])
    };
    let write = |runs: &str| write_with("", runs);
    let before = write("10,20,18");
    assert_ne!(write("11,20,17"), before, "other runs in a data set of the same length");
    assert_eq!(write("10,20,18"), before);
    let of_another = r#"{"image_id":2,"segmentation":{"size":[6,8],"counts":[9,20,19]}},"#;
    assert_eq!(write_with(of_another, "10,20,18"), before, "masks of another view");
}

fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    fs_err::create_dir(dir.path().join("left")).unwrap();
    dir
}

fn write_png(path: &Path, color: png::ColorType, depth: png::BitDepth, rows: &[u8]) {
    let mut encoder = png::Encoder::new(fs_err::File::create(path).unwrap(), 8, 6);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_palette(vec![7; 3 * 16]);
    encoder.write_header().unwrap().write_image_data(rows).unwrap();
}

/// The ids 0, 3 and 255 on an 8 x 6 image, in every kind of PNG that can hold them or similar ones.
#[test]
fn id_images_of_every_depth() {
    let dir = folder();
    let id_at = |x: u32, y: u32| if x == 7 { 15 } else { 3 * u32::from(x >= 2 && y >= 1 && x < 6) };
    let expected = [mask(8, 6, |x, y| id_at(x, y) == 3).unwrap(), mask(8, 6, |x, _| x == 7).unwrap()];
    let pixels = || (0..6).flat_map(|y| (0..8).map(move |x| (x, y)));
    let eight: Vec<u8> = pixels().map(|(x, y)| id_at(x, y) as u8).collect();
    let four: Vec<u8> = eight.chunks(2).map(|pair| pair[0] << 4 | pair[1]).collect();
    let sixteen: Vec<u8> = pixels().flat_map(|(x, y)| (id_at(x, y) as u16 * 1_000).to_be_bytes()).collect();
    let (gray, palette) = (png::ColorType::Grayscale, png::ColorType::Indexed);
    for (name, color, depth, rows) in [
        ("left/a.png", gray, png::BitDepth::Eight, &eight),
        ("left/a.png", gray, png::BitDepth::Four, &four),
        ("left/a.jpg.png", gray, png::BitDepth::Sixteen, &sixteen),
        ("left/a.png", palette, png::BitDepth::Eight, &eight),
        ("left/a.jpg.png", palette, png::BitDepth::Four, &four),
    ] {
        let path = dir.path().join(name);
        write_png(&path, color, depth, rows);
        assert_eq!(load(dir.path(), &[], None).unwrap().unwrap(), expected, "{color:?} {depth:?}");
        let factor = if depth == png::BitDepth::Sixteen { 1_000 } else { 1 };
        assert_eq!(load(dir.path(), &[15 * factor], None).unwrap().unwrap(), expected[..1]);
        fs_err::remove_file(path).unwrap();
    }
    assert_eq!(load(dir.path(), &[], None).unwrap(), None);
    // One bit: the only id is 1.
    write_png(&dir.path().join("left/a.png"), gray, png::BitDepth::One, &[0b0011_1100; 6]);
    let stripe = mask(8, 6, |x, _| (2..6).contains(&x)).unwrap();
    assert_eq!(load(dir.path(), &[], None).unwrap().unwrap(), [stripe]);
}

#[test]
fn id_images_of_the_wrong_kind_or_size_are_refused() {
    let dir = folder();
    let path = dir.path().join("left/a.png");
    RgbImage::new(8, 6).save(&path).unwrap();
    assert!(load(dir.path(), &[], None).unwrap_err().to_string().contains("found RGB pixels, expected ids"));
    fs_err::write(&path, b"<!DOCTYPE html><title>Log in</title>").unwrap();
    assert!(load(dir.path(), &[], None).unwrap_err().to_string().contains("a web page"));
    GrayImage::new(6, 8).save(&path).unwrap();
    let size = load(dir.path(), &[], None).unwrap_err();
    assert!(matches!(size, SegmentError::Size { found_px: [6, 8], expected_px: [8, 6], .. }), "{size}");
    // A small file that inflates far beyond the photo is refused by its header.
    GrayImage::new(6_000, 6_000).save(&path).unwrap();
    let (loaded, taken) = memory_of(|| load(dir.path(), &[], None));
    assert!(matches!(loaded, Err(SegmentError::Size { found_px: [6_000, 6_000], .. })));
    assert!(taken.largest_bytes < 100_000, "{taken:?}");
}

/// A mask drawn with antialiasing: each grey level would become a mask.
#[test]
fn soft_edges_are_no_ids() {
    let dir = folder();
    let ramp: Vec<u8> =
        (0..48).map(|at| [0, 0, 20 + at, 90 + at, 160 + at, 255, 255, 255][at as usize % 8]).collect();
    let (gray, eight) = (png::ColorType::Grayscale, png::BitDepth::Eight);
    write_png(&dir.path().join("left/a.png"), gray, eight, &ramp);
    assert_error(load(dir.path(), &[], None), &["soft edges: 18 values"]);
    // Ids 3 and 60 enlarged smoothly.
    let seams: Vec<u8> =
        (0..48).map(|at| [3, 3, 3, 15 + at / 8, 40 + at / 8, 60, 60, 60][at as usize % 8]).collect();
    write_png(&dir.path().join("left/a.png"), gray, eight, &seams);
    assert!(load(dir.path(), &[], None).unwrap_err().to_string().contains("INTER_NEAREST"));
    write_png(&dir.path().join("left/a.png"), gray, eight, &ramp);
    // A black and white image of one mask is thresholded at half.
    fs_err::create_dir(dir.path().join("left/a")).unwrap();
    fs_err::rename(dir.path().join("left/a.png"), dir.path().join("left/a/0.png")).unwrap();
    let half = mask(8, 6, |x, y| ramp[(y * 8 + x) as usize] >= 128).unwrap();
    assert_eq!(load(dir.path(), &[], None).unwrap().unwrap(), [half]);
}

#[test]
fn run_length_files_of_every_form() {
    let dir = folder();
    let path = dir.path().join("left/a.json");
    let [a, b] = [mask(8, 6, |x, _| x < 5).unwrap(), mask(8, 6, |x, y| x > 2 && y > 1).unwrap()];
    // Columns of 6: three outside, then each two outside and four inside.
    let runs = [vec![18 + 2], vec![4, 2, 4, 2, 4, 2, 4, 2, 4]].concat();
    let annotations = serde_json::json!([
        {"segmentation": {"size": [6, 8], "counts": "0n0b0"}, "area": 30, "predicted_iou": 0.9, "image_id": 9},
        {"segmentation": {"counts": runs, "size": [6, 8]}, "bbox": [3, 2, 5, 4], "image_id": 9},
        {"segmentation": {"size": [6, 8], "counts": [48]}, "image_id": 9},
    ]);
    fs_err::write(&path, annotations.to_string()).unwrap();
    assert_eq!(load(dir.path(), &[], None).unwrap().unwrap(), [a.clone(), b.clone()]);
    let object = serde_json::json!({"image": {"file_name": "x"}, "annotations": annotations});
    fs_err::write(&path, object.to_string()).unwrap();
    assert_eq!(load(dir.path(), &[], None).unwrap().unwrap(), [a.clone(), b.clone()]);

    let data_set = serde_json::json!({"images": [{"id": 8, "file_name": "b.jpg"},
        {"id": 9, "file_name": "left/a.jpg", "width": 8}], "annotations": annotations});
    let whole = dir.path().join("coco.json");
    fs_err::write(&whole, data_set.to_string()).unwrap();
    assert_eq!(load(&whole, &[], None).unwrap().unwrap(), [a, b]);
    let given = GivenMasks::open(&whole, Vec::new()).unwrap();
    assert!(given.covers(&view("b.jpg", 8, 6)) && !given.covers(&view("c.jpg", 8, 6)));

    // Polygons, clockwise or not, outside of the image, with holes by a second turn; several make one mask.
    for polygons in [
        vec![vec![1.2, 0.9, 6.7, 2.2, 3.1, 5.4]],
        vec![vec![-3.0, -2.0, 4.5, 9.0, 20.0, 1.0], vec![0.0, 3.0, 0.0, 6.0, 2.0, 6.0, 2.0, 3.0]],
        vec![vec![
            0.0, 0.0, 8.0, 0.0, 8.0, 6.0, 0.0, 6.0, 0.0, 0.0, 2.0, 2.0, 2.0, 4.0, 5.0, 4.0, 5.0, 2.0, 2.0,
            2.0,
        ]],
    ] {
        // Oracle: crossings of a ray along x from each pixel's middle.
        let inside = |points: &[f64], x: f64, y: f64| {
            let n = points.len() / 2;
            let crosses = |i: &usize| {
                let [a, b] = [*i, (*i + 1) % n].map(|i| (points[2 * i], points[2 * i + 1]));
                (a.1 > y) != (b.1 > y) && x < a.0 + (y - a.1) / (b.1 - a.1) * (b.0 - a.0)
            };
            (0..n).filter(crosses).count() % 2 == 1
        };
        let middle = |v: u32| f64::from(v) + 0.5;
        let drawn = mask(8, 6, |x, y| polygons.iter().any(|p| inside(p, middle(x), middle(y))));
        let data_set = serde_json::json!({"images": [{"id": 9, "file_name": "left/a.jpg", "width": 8, "height": 6}],
            "annotations": [{"segmentation": polygons, "image_id": 9}]});
        fs_err::write(&whole, data_set.to_string()).unwrap();
        assert_eq!(load(&whole, &[], None).unwrap().unwrap(), [drawn.unwrap()], "{polygons:?}");
    }
    for (polygon, n) in [(&[1.0, 2.0][..], 2), (&[0.0; 7], 7)] {
        assert_eq!(Rle::from_polygons(8, 6, &[polygon.to_vec()]), Err(RleError::Polygon { index: 0, n }));
    }

    // Masks that would be lost, or assigned to another photo.
    for (images, id, expected) in [
        (r#"{"id": 8, "file_name": "left/a.jpg"}"#, "9", "mask 0 has image_id 9, which no image has"),
        (r#"{"id": 8, "file_name": "left/a.jpg"}"#, "null", "mask 0 has image_id none"),
        (
            r#"{"id": 8, "file_name": "left/a.jpg"}, {"id": 8, "file_name": "b"}"#,
            "8",
            "two images have the id 8",
        ),
        (r#"{"id": 8, "file_name": "b"}, {"id": 7, "file_name": "b"}"#, "8", "two images have the file_name"),
    ] {
        let mask = format!(r#"{{"segmentation": {{"size": [6, 8], "counts": [48]}}, "image_id": {id}}}"#);
        fs_err::write(&whole, format!(r#"{{"images": [{images}], "annotations": [{mask}]}}"#)).unwrap();
        assert_error(load(&whole, &[], None), &[expected, "coco.json"]);
    }

    for (json, expected) in [
        (r#"[{"segmentation": [[1, 2, 3, 4, 5, 6]]}]"#, "polygons"),
        (r#"[{"segmentation": {"size": [6, 8], "counts": [47]}}]"#, "mask 0: runs add up to 47"),
        (r#"[{"segmentation": {"size": [8, 6], "counts": [48]}}]"#, "the masks have 6 x 8 px"),
        (r#"[{"segmentation": 3}]"#, "SAM's list"),
        ("", "SAM's list"),
    ] {
        fs_err::write(&path, json).unwrap();
        assert_error(load(dir.path(), &[], None), &[expected, "a.json"]);
    }
}

/// Run lengths of a mask of 8 x 6 pixels.
fn counts(mask: &Mask) -> Vec<u32> {
    let mut counts = vec![0];
    for at in 0..48 {
        if mask.contains(at / 6, at % 6) != counts.len().is_multiple_of(2) {
            counts.push(0);
        }
        *counts.last_mut().unwrap() += 1;
    }
    counts
}

/// Both kinds of mask files are undistorted exactly like a label image.
#[test]
fn masks_are_undistorted_like_the_photo() {
    let dir = folder();
    let mut camera = view("a", 8, 6).intrinsics;
    (camera.focal_x_px, camera.focal_y_px) = (5.0, 5.0);
    camera.distortion = Distortion::Brown { k: [0.5, 0.0, 0.0], p: [0.02, 0.0] };
    let undistorter = Undistorter::new(camera);
    let masks: Vec<Mask> = (0..3).filter_map(|i| mask(8, 6, |x, y| (x + y * i) % 4 > i || y == 5)).collect();
    let annotations: Vec<_> = masks
        .iter()
        .map(|m| serde_json::json!({"segmentation": {"size": [6, 8], "counts": counts(m)}}))
        .collect();
    fs_err::write(dir.path().join("left/a.json"), serde_json::json!(annotations).to_string()).unwrap();
    let through_lens = |m: &Mask| {
        let labels: Vec<u32> = (0..48).map(|at| u32::from(m.contains(at % 8, at / 8))).collect();
        let ideal = undistorter.labels(&labels, 0);
        mask(8, 6, |x, y| ideal[(y * 8 + x) as usize] == 1).unwrap()
    };
    let expected: Vec<Mask> = masks.iter().map(through_lens).collect();
    assert_ne!(expected, masks, "the lens must move something");
    assert_eq!(load(dir.path(), &[], Some(&undistorter)).unwrap().unwrap(), expected);

    let ids: Vec<u8> = (0..48).map(|at| u8::from(masks[0].contains(at % 8, at / 8))).collect();
    GrayImage::from_raw(8, 6, ids).unwrap().save(dir.path().join("left/a.png")).unwrap();
    assert_eq!(load(dir.path(), &[], Some(&undistorter)).unwrap().unwrap(), expected[..1]);
}

/// Oracle: pixels of each instance over all views, counted by the scene's generator.
#[needs_shared]
fn house_masks_have_the_pixels_that_the_scene_states() {
    let scene = shared("scenes/house_a");
    let stated: serde_json::Value =
        serde_json::from_slice(&fs_err::read(scene.join("gt/instances.json")).unwrap()).unwrap();
    let mut stated_px = std::collections::BTreeMap::new();
    for group in ["background", "instances"] {
        for instance in stated[group].as_array().unwrap() {
            stated_px
                .insert(instance["id"].as_u64().unwrap() as u32, instance["train_pixels"].as_u64().unwrap());
        }
    }
    let given = GivenMasks::open(&scene.join("gt/masks"), vec![255]).unwrap();
    let mut found_px = std::collections::BTreeMap::new();
    let image = RgbImage::new(640, 480);
    for view in &poses::read(&scene, None).unwrap().views {
        let png =
            image::open(scene.join("gt/masks").join(&view.name).with_extension("png")).unwrap().into_luma8();
        for mask in given.load(&input(view, &image)).unwrap().unwrap() {
            // A mask carries no id, so take that of any of its pixels.
            let first = mask.inside.iter().position(|inside| inside).unwrap() as u32;
            let (x, y) = (first % mask.box_px.width_px(), first / mask.box_px.width_px());
            let id = u32::from(png.get_pixel(mask.box_px.x0 + x, mask.box_px.y0 + y).0[0]);
            *found_px.entry(id).or_insert(0) += u64::from(mask.area_px);
        }
    }
    stated_px.retain(|_, pixels| *pixels > 0);
    assert_eq!(found_px, stated_px);
    assert_eq!(found_px.values().sum::<u64>(), 96 * 640 * 480);
}

/// Width and height.
type SizePx = (u32, u32);

/// The set of masks of every raster pixel.
fn sets_of_pixels(masks: &[Mask], size: SizePx, target: SizePx, valid: Option<&[bool]>) -> Vec<Vec<u32>> {
    let nearest =
        |i: u32, size: u32, target: u32| ((f64::from(i) + 0.5) * f64::from(size) / f64::from(target)) as u32;
    let pixels = (0..target.1).flat_map(|y| (0..target.0).map(move |x| (x, y)));
    pixels
        .map(|(x, y)| (nearest(x, size.0, target.0), nearest(y, size.1, target.1)))
        .map(|(x, y)| match valid {
            Some(valid) if !valid[(y * size.0 + x) as usize] => Vec::new(),
            _ => (0_u32..).zip(masks).filter(|(_, mask)| mask.contains(x, y)).map(|(i, _)| i).collect(),
        })
        .collect()
}

fn check_partition(masks: &[Mask], size: (u32, u32), target: (u32, u32), valid: Option<&[bool]>) {
    let (map, masks_of_region) = partition(masks, size.0, size.1, target.0, target.1, valid);
    assert_eq!((map.width_px, map.height_px), target);
    assert_eq!(map.n_regions as usize, masks_of_region.len());
    let mut next = 0;
    let sets = sets_of_pixels(masks, size, target, valid);
    assert_eq!(map.region_of_pixel.len(), sets.len());
    for (region, set) in map.region_of_pixel.iter().zip(&sets) {
        if *region == NO_REGION {
            assert!(set.is_empty());
            continue;
        }
        assert_eq!(&masks_of_region[*region as usize], set);
        assert!(!set.is_empty() && *region <= next, "regions are numbered in scan order");
        next = next.max(region + 1);
    }
    assert_eq!(next, map.n_regions);
    // No two regions have the same set, so regions are exactly the distinct sets.
    let distinct: std::collections::BTreeSet<_> = masks_of_region.iter().collect();
    assert_eq!(distinct.len(), masks_of_region.len());
}

fn random_mask(random: &mut Random, width: u32, height: u32) -> Mask {
    let mut below = |n: u32| random.below(n as usize) as u32;
    let (x, y, w, h, holes) =
        (below(width), below(height), 1 + below(width), 1 + below(height), 1 + below(5));
    mask(width, height, |px, py| {
        let in_box = px >= x && py >= y && px < x + w && py < y + h;
        (px, py) == (x, y) || in_box && (px * 3 + py * 5) % (holes + 1) != 0
    })
    .unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn regions_are_the_distinct_sets_of_masks(
        seed: u64, n in 0_usize..12, size in (1_u32..40, 1_u32..30), target in (1_u32..60, 1_u32..60), holes: bool,
    ) {
        let mut random = Random::new(seed);
        let mut masks: Vec<Mask> = (0..n).map(|_| random_mask(&mut random, size.0, size.1)).collect();
        // Equal masks, and one of a single pixel.
        masks.extend(masks.first().cloned());
        masks.extend(mask(size.0, size.1, |x, y| (x, y) == (size.0 / 2, size.1 / 2)).filter(|_| n > 0));
        let valid: Vec<bool> = (0..size.0 * size.1).map(|_| random.below(5) > 0).collect();
        check_partition(&masks, size, target, holes.then_some(&valid[..]));
    }
}

#[test]
fn three_hundred_overlapping_masks() {
    let mut random = Random::new(3);
    let masks: Vec<Mask> = (0..300).map(|_| random_mask(&mut random, 64, 48)).collect();
    check_partition(&masks, (64, 48), (64, 48), None);
    check_partition(&masks, (64, 48), (31, 100), None);
    check_partition(&[], (64, 48), (64, 48), None);
    assert_eq!(partition(&masks, 64, 48, 64, 48, Some(&[false; 64 * 48])).0.n_regions, 0);
}

/// Slivers join the neighbour with the longest border, except a mask's only region and those without a neighbour.
#[test]
fn slivers_go_to_their_neighbours() {
    let inside =
        |x: u32, y: u32, (x0, y0, x1, y1): (u32, u32, u32, u32)| x >= x0 && x < x1 && y >= y0 && y < y1;
    // Slivers have at most 11 pixels in this raster. Left and right overlap in a column of 11 that ends at the
    // lower edge of both, and in an island of 4; the nail is on the left one.
    let (island, nail, size) = ((380, 280, 382, 282), (20, 20, 24, 22), (400, 300));
    let left = |x, y| inside(x, y, (10, 10, 101, 50)) && (x < 100 || y >= 39) || inside(x, y, island);
    let right = |x, y| inside(x, y, (100, 10, 150, 50)) || inside(x, y, island);
    let masks = [
        mask(size.0, size.1, left).unwrap(),
        mask(size.0, size.1, right).unwrap(),
        mask(size.0, size.1, |x, y| inside(x, y, nail)).unwrap(),
    ];
    let (mut map, mut masks_of_region) = partition(&masks, size.0, size.1, size.0, size.1, None);
    let at = |map: &RegionMap, x: u32, y: u32| map.region_of_pixel[(y * size.0 + x) as usize];
    let set = |map: &RegionMap, sets: &[Vec<u32>], x, y| sets[at(map, x, y) as usize].clone();
    assert_eq!(set(&map, &masks_of_region, 100, 45), [0, 1], "the island's region, too large for its masks");
    assert_eq!(at(&map, 100, 45), at(&map, 380, 280));
    let before = map.clone();
    absorb_slivers(&mut map, &mut masks_of_region);
    assert_eq!(map, before, "15 pixels are no sliver");

    // Without the island: 11 pixels, 11 + 0 along the left, 11 + 1 along the right.
    let left = mask(size.0, size.1, |x, y| left(x, y) && !inside(x, y, island)).unwrap();
    let masks = [left, masks[1].clone(), masks[2].clone()];
    let (mut map, mut masks_of_region) = partition(&masks, size.0, size.1, size.0, size.1, None);
    assert_eq!(map.n_regions, 4);
    absorb_slivers(&mut map, &mut masks_of_region);
    assert_eq!((map.n_regions, masks_of_region.len()), (3, 3));
    for (x, y, expected) in [(100, 45, 1), (100, 38, 1), (99, 45, 0), (380, 280, 1)] {
        assert_eq!(set(&map, &masks_of_region, x, y), [expected], "{x} {y}");
    }
    assert_eq!(set(&map, &masks_of_region, 22, 21), [0, 2], "8 pixels, but all that the nail has");
    assert_eq!(at(&map, 300, 200), NO_REGION);

    // Two masks whose only common pixels are apart from the rest of both.
    let far = |box_px| move |x, y| inside(x, y, box_px) || inside(x, y, island);
    let masks = [(0, 0, 60, 60), (200, 0, 260, 60)].map(|b| mask(size.0, size.1, far(b)).unwrap());
    let (mut map, mut masks_of_region) = partition(&masks, size.0, size.1, size.0, size.1, None);
    let before = map.clone();
    absorb_slivers(&mut map, &mut masks_of_region);
    assert_eq!(map, before, "without a neighbour it stays");
}

/// An object behind a grid of others, cut into nine slivers of 10 pixels: the largest stays, the others go.
#[test]
fn a_mask_cut_into_slivers_keeps_one() {
    let (width, height) = (400, 300);
    let strips: Vec<Mask> = (0..9).map(|i| mask(width, height, |x, _| x / 10 == i).unwrap()).collect();
    // A line of ten pixels per strip; the fourth piece has one more, below.
    let thing = mask(width, height, |x, y| (x < 90 && y == 150) || (x, y) == (33, 151)).unwrap();
    let masks: Vec<Mask> = strips.into_iter().chain([thing]).collect();
    let (mut map, mut masks_of_region) = partition(&masks, width, height, width, height, None);
    assert_eq!(map.n_regions, 18);
    absorb_slivers(&mut map, &mut masks_of_region);
    assert_eq!((map.n_regions, masks_of_region.len()), (10, 10));
    let set = |x: u32, y: u32| &masks_of_region[map.region_of_pixel[(y * width + x) as usize] as usize];
    assert_eq!(set(35, 150), &[3, 9]);
    assert_eq!(set(33, 151), &[3, 9]);
    assert_eq!(set(25, 150), &[2]);
    assert_eq!(masks_of_region.iter().filter(|set| set.contains(&9)).count(), 1);
}

/// Masks without a photo are refused by name; folders of `amg.py` and entries with other folders are matched.
#[test]
fn masks_are_matched_with_their_photos() {
    let dir = tempfile::tempdir().unwrap();
    let views = [view("a.jpg", 4, 3), view("b.jpg", 4, 3)];
    let check = |path: &Path, strict| {
        GivenMasks::open(path, Vec::new()).unwrap().check_views(&views, strict).map_err(|e| e.to_string())
    };
    let refused = check(dir.path(), false).unwrap_err();
    assert!(refused.contains("\"a.jpg\"") && refused.contains("found nothing"), "{refused}");
    fs_err::write(dir.path().join("a_s.npy"), "").unwrap();
    assert!(check(dir.path(), false).unwrap_err().contains("LangSplat"));
    let amg = dir.path().join("a");
    fs_err::create_dir(&amg).unwrap();
    let white = |at: usize| (0..12).map(|i| if i == at { 255 } else { 0 }).collect::<Vec<u8>>();
    for number in [0, 1, 10] {
        let path = amg.join(format!("{number}.png"));
        GrayImage::from_raw(4, 3, white(number)).unwrap().save(path).unwrap();
    }
    let said = check(dir.path(), false).unwrap().unwrap();
    assert!(said.contains("1 of 2") && said.contains("b.jpg"), "{said}");
    assert!(check(dir.path(), true).unwrap_err().contains("--strict"));
    let image = RgbImage::new(4, 3);
    let given = GivenMasks::open(dir.path(), vec![255]).unwrap();
    let masks = given.load(&input(&views[0], &image)).unwrap().expect("masks");
    let corners: Vec<_> = masks.iter().map(|mask| (mask.box_px.x0, mask.box_px.y0)).collect();
    assert_eq!(corners, [(0, 0), (1, 0), (2, 2)]);

    let path = dir.path().join("coco.json");
    for (names, covered) in [
        (["images/a.jpg", "images/b.jpg"], true),
        (["a_jpg.rf.1f.jpg", "b_jpg.rf.2e.jpg"], true),
        (["x.jpg", "y.jpg"], false),
        (["left/a.jpg", "right/a.jpg"], false),
    ] {
        let images: Vec<String> = names
            .iter()
            .enumerate()
            .map(|(id, name)| format!(r#"{{"id": {id}, "file_name": "{name}"}}"#))
            .collect();
        fs_err::write(&path, format!(r#"{{"images": [{}], "annotations": []}}"#, images.join(","))).unwrap();
        assert_eq!(check(&path, true).is_ok(), covered, "{names:?}");
    }
    // Photos of two cameras with one name: an entry without a folder is ambiguous.
    let rig = [view("left/0.jpg", 4, 3), view("right/0.jpg", 4, 3)];
    let of = |file_name: &str| {
        let text = format!(r#"{{"images": [{{"id": 1, "file_name": "{file_name}"}}], "annotations": []}}"#);
        fs_err::write(&path, format!("\u{feff}{text}")).unwrap();
        let given = GivenMasks::open(&path, Vec::new()).unwrap();
        let found = given.check_views(&rig, false).map_err(|e| e.to_string());
        (rig.iter().map(|view| given.covers(view)).collect::<Vec<_>>(), found)
    };
    let (_, refused) = of("0.jpg");
    assert!(refused.unwrap_err().contains("may be \"left/0.jpg\" or \"right/0.jpg\""));
    for name in ["right/0.jpg", r"D:\\masks\\right\\0.jpg"] {
        let (covered, found) = of(name);
        assert!(covered == [false, true] && found.unwrap().unwrap().contains("1 of 2"), "{name}");
    }
    let utf16: Vec<u8> = "[]".encode_utf16().flat_map(u16::to_le_bytes).collect();
    fs_err::write(&path, utf16).unwrap();
    assert_error(GivenMasks::open(&path, Vec::new()), &["coco.json: the text is UTF-16"]);

    for ending in ["png", "json"] {
        fs_err::write(dir.path().join("b").with_extension(ending), "").unwrap();
    }
    let said = check(dir.path(), true).unwrap().unwrap();
    assert!(said.contains("b.png is read") && said.ends_with("b.json beside it is not"), "{said}");
}

/// Counted from 1 in place of 0, one name is a photo's, and the wrong one; of a part of the photos, all are right.
#[test]
fn masks_of_other_photos_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let views = ["0.jpg", "9.jpg", "18.jpg", "1.jpg"].map(|name| view(name, 4, 3));
    let check = || {
        let given = GivenMasks::open(dir.path(), Vec::new()).unwrap();
        given.check_views(&views, false).map_err(|error| error.to_string())
    };
    fs_err::write(dir.path().join("1.json"), "[]").unwrap();
    assert!(check().unwrap().unwrap().contains("3 of 4"));
    for other in ["2.json", "3.json", "4.json"] {
        fs_err::write(dir.path().join(other), "[]").unwrap();
    }
    let error = check().unwrap_err();
    assert!(error.contains("3 of 4") && error.contains("2.json, 3.json, 4.json"), "{error}");
}

/// A file of masks that two photos share is refused, until each has its own.
#[test]
fn masks_belong_to_one_photo() {
    let dir = tempfile::tempdir().unwrap();
    let views = [view("a.jpg", 4, 3), view("a.png", 4, 3)];
    let check = || {
        let given = GivenMasks::open(dir.path(), Vec::new()).unwrap();
        given.check_views(&views, true).map_err(|error| error.to_string())
    };
    fs_err::write(dir.path().join("a.json"), "[]").unwrap();
    let error = check().unwrap_err();
    assert!(error.contains(r#""a.jpg" or of "a.png""#) && error.contains("a.jpg.png"), "{error}");
    fs_err::remove_file(dir.path().join("a.json")).unwrap();
    for view in &views {
        fs_err::write(dir.path().join(format!("{}.json", view.name)), "[]").unwrap();
    }
    check().unwrap();
}
