//! Automatic masks of Segment Anything 2: photos are stretched, prompts without an object give no mask.

use slag_common::pinhole;

use super::*;

fn open(settings: SamSettings) -> SamSegmenter {
    let session = SessionOptions::new(onnx_runtime());
    let dir = workspace_root().join("tests/models/sam2_tiny");
    SamSegmenter::open(&dir, settings, &session, &[0]).expect("it opens")
}

fn photo() -> image::RgbImage {
    let golden = workspace_root().join("tests/models/sam2_tiny/golden.npz");
    let (shape, levels) = array::<u8>(&golden, "image");
    image::RgbImage::from_raw(shape[1] as u32, shape[0] as u32, levels).expect("RGB")
}

fn all(points_per_side: u32) -> SamSettings {
    SamSettings {
        points_per_side,
        points_per_batch: 4,
        predicted_iou: 0.0,
        stability: 0.0,
        box_nms_iou: 1.0,
        ..SamSettings::default()
    }
}

fn segment(segmenter: &SamSegmenter, image: &image::RgbImage) -> Vec<Mask> {
    let intrinsics = pinhole(image.dimensions().into(), 100.0);
    let camera_from_world = glam::DAffine3::IDENTITY;
    let view = View { name: "photo".into(), image_path: "photo".into(), intrinsics, camera_from_world };
    let input = SegmentInput { view: &view, image, valid: None, undistorter: None, depth: None, pool: None };
    segmenter.segment(&input).expect("it segments")
}

/// The recorded prompts are a grid of 3 x 3; a logit below 0 means no object. Oracle: one bilinear step in float64 from
/// the logits, which another test compares with PyTorch's.
#[test]
fn masks_are_those_of_prompts_with_an_object() {
    let (segmenter, photo) = (open(all(3)), photo());
    let golden = workspace_root().join("tests/models/sam2_tiny/golden.npz");
    let (_, objects) = array::<f32>(&golden, "object_score_logits");
    let (_, points) = array::<f32>(&golden, "points");
    let embedding = segmenter.lanes.take().embed(&photo).expect("it runs");
    let decoded = segmenter.lanes.take().decode(&embedding, 9, points.as_chunks::<2>().0, &[1; 9]).unwrap();
    let size = [photo.width() as usize, photo.height() as usize];
    let mut expected: Vec<(u8, Vec<bool>)> = Vec::new();
    for (k, logits) in decoded.logits.chunks_exact(64 * 64).enumerate() {
        let logits: Vec<f64> = logits.iter().map(|&logit| f64::from(logit)).collect();
        let inside: Vec<bool> = bilinear(&logits, [64, 64], size).iter().map(|&logit| logit > 0.0).collect();
        if objects[k / 3] > 0.0 && inside.contains(&true) {
            expected.push((2 - (k % 3) as u8, inside));
        }
    }
    let found = segment(&segmenter, &photo);
    assert_eq!(found.len(), expected.len());
    assert!((3..27).contains(&found.len()), "{}", found.len());
    for mask in &found {
        let pixels = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (x as u32, y as u32)));
        let inside: Vec<bool> = pixels.map(|(x, y)| mask.contains(x, y)).collect();
        // Logits in f32 and f64 may differ at the border.
        let differing = |other: &[bool]| other.iter().zip(&inside).filter(|(a, b)| a != b).count();
        let nearest = expected.iter().filter(|(level, _)| *level == mask.level);
        assert!(nearest.map(|(_, other)| differing(other)).min().is_some_and(|n| n < 3));
    }
}

/// `torch.nn.functional.interpolate` is the reference's post-processing.
#[test]
fn masks_are_enlarged_in_one_step() {
    let segmenter = open(all(3));
    let golden = workspace_root().join("tests/models/sam2_tiny/golden.npz");
    let photo = photo();
    let embedding = segmenter.lanes.take().embed(&photo).expect("it runs");
    let (_, points) = array::<f32>(&golden, "points");
    let decoded =
        segmenter.lanes.take().decode(&embedding, 1, &points.as_chunks::<2>().0[..1], &[1]).expect("it runs");
    let (shape, expected) = array::<f32>(&golden, "first_masks_enlarged_sub3");
    let upsampler = Upsampler::new(&embedding.letterbox, decoded.logits_px);
    let mut n_inside = 0;
    for (k, logits) in decoded.logits.chunks_exact(64 * 64).enumerate() {
        let mask = upsampler.cut(logits, 0.0, [0, 0]).map(|cut| cut.mask.to_mask(0));
        for y in 0..shape[1] {
            for x in 0..shape[2] {
                let logit = expected[(k * shape[1] + y) * shape[2] + x];
                let found = mask.as_ref().is_some_and(|mask| mask.contains(3 * x as u32, 3 * y as u32));
                assert!(found == (logit > 0.0) || logit.abs() < 1e-4, "mask {k} at {x} {y}: {logit}");
                n_inside += u32::from(found);
            }
        }
    }
    assert!(n_inside > 100, "{n_inside}");
}

/// Images larger and smaller than the logits; low-frequency noise, so that masks have borders everywhere.
#[test]
fn stretched_masks_equal_a_plain_recomputation() {
    let logits: Vec<f32> = (0..64 * 64)
        .map(|i| {
            let (x, y) = (f64::from(i % 64), f64::from(i / 64));
            ((0.31 * x + 0.1 * y).sin() + (0.17 * y - 0.05 * x).cos() - 0.1) as f32
        })
        .collect();
    let dense: Vec<f64> = logits.iter().map(|&logit| f64::from(logit)).collect();
    for image_px in [[20, 30], [64, 64], [3, 700], [500, 311], [1, 1]] {
        let upsampler = Upsampler::new(&Letterbox::stretched(256, image_px), [64, 64]);
        let expected = bilinear(&dense, [64, 64], image_px.map(|edge| edge as usize));
        let mask = upsampler.cut(&logits, 0.0, [0, 0]).map(|cut| cut.mask.to_mask(0));
        for (at, logit) in expected.iter().enumerate() {
            let (x, y) = (at as u32 % image_px[0], at as u32 / image_px[0]);
            let found = mask.as_ref().is_some_and(|mask| mask.contains(x, y));
            assert!(found == (*logit > 0.0) || logit.abs() < 1e-5, "{image_px:?} at {x} {y}: {logit}");
        }
    }
}
