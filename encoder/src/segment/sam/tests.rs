//! Compares the filters with an independent recomputation on synthetic logits: float64, dense arrays, no shared
//! code.

mod langsplat;
mod levels;
mod sam2;

use slag_common::View;
use slag_math::random::Random;
use slag_models::SessionOptions;
use slag_models::sam::{Decoded, Letterbox};
use slag_test_support::{needs_shared, npz_array as array, onnx_runtime, shared, workspace_root};

use super::filter::Filters;
use super::runs::{Run, RunMask};
use super::upsample::Upsampler;
use super::{SamSegmenter, SamSettings, points};
use crate::ingest::LoadedImage;
use crate::masks::{BoxPx, Mask};
use crate::segment::{SegmentInput, Segmenter};

/// Edges of square and logits, pixels, in SAM's proportion.
const SIZE_PX: u32 = 256;
const LOGITS_PX: u32 = 64;

/// A round object in logits: centre and radius in the square, slope of the logits, and predicted IoU.
#[derive(Clone, Copy)]
struct Blob {
    centre: [f64; 2],
    radius: f64,
    slope: f64,
    /// A hole or an island: centre, radius and slope.
    spot: Option<([f64; 2], f64, f64)>,
    predicted_iou: f32,
}

fn logits(blob: &Blob) -> Vec<f32> {
    let scale = f64::from(SIZE_PX / LOGITS_PX);
    let at = |i: u32| (f64::from(i % LOGITS_PX) + 0.5, f64::from(i / LOGITS_PX) + 0.5);
    (0..LOGITS_PX * LOGITS_PX)
        .map(|i| {
            let (x, y) = (at(i).0 * scale, at(i).1 * scale);
            let inside = |centre: [f64; 2], radius: f64| radius - (x - centre[0]).hypot(y - centre[1]);
            let thing = blob.slope * inside(blob.centre, blob.radius);
            let logit = match blob.spot {
                Some((centre, radius, slope)) if slope < 0.0 => thing.min(slope * inside(centre, radius)),
                Some((centre, radius, slope)) => thing.max(slope * inside(centre, radius)),
                None => thing,
            };
            logit as f32
        })
        .collect()
}

/// Synthetic answers to `n` prompts. Many objects repeat; some are soft, have a low predicted IoU, are cut, or have
/// holes or islands.
fn blobs(n: usize, seed: u64, extent: [f64; 2]) -> Vec<Blob> {
    let mut state = seed;
    let mut random = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / (1_u64 << 31) as f64
    };
    let mut blobs: Vec<Blob> = Vec::new();
    for k in 0..3 * n {
        let again = k > 6 && random() < 0.4;
        let mut blob = match again {
            true => blobs[(random() * blobs.len() as f64) as usize],
            false => Blob {
                centre: [random() * extent[0], random() * extent[1]],
                radius: 12.0 + 40.0 * random(),
                slope: 0.2 + 1.5 * random() * random(),
                spot: None,
                predicted_iou: 0.0,
            },
        };
        blob.radius += 6.0 * random();
        blob.predicted_iou = (0.8 + 0.2 * random()) as f32;
        let to_side = |part: f64| [blob.centre[0] + part * blob.radius, blob.centre[1]];
        blob.spot = match (random() * 5.0) as u32 {
            0 => Some((to_side(0.3), 3.0 + 5.0 * random(), -3.0)),
            1 => Some((to_side(1.6), 4.0 + 5.0 * random(), 3.0)),
            _ => None,
        };
        blobs.push(blob);
    }
    blobs
}

fn decoded(blobs: &[Blob]) -> Decoded {
    Decoded {
        predicted_ious: blobs.iter().map(|blob| blob.predicted_iou).collect(),
        logits: blobs.iter().flat_map(logits).collect::<Vec<_>>().into(),
        logits_px: [LOGITS_PX; 2],
        object_logits: Vec::new(),
    }
}

/// Bilinear in float64 with aligned pixel centres, from `[height][width]` to `[to[1]][to[0]]`.
fn bilinear(values: &[f64], [width, height]: [usize; 2], to: [usize; 2]) -> Vec<f64> {
    let source = |at: usize, n_in: usize, n_out: usize| {
        let s = ((at as f64 + 0.5) * n_in as f64 / n_out as f64 - 0.5).max(0.0);
        let low = (s.floor() as usize).min(n_in - 1);
        (low, (low + 1).min(n_in - 1), s - low as f64)
    };
    let mut out = Vec::new();
    for y in 0..to[1] {
        let (y0, y1, fy) = source(y, height, to[1]);
        for x in 0..to[0] {
            let (x0, x1, fx) = source(x, width, to[0]);
            let row = |y: usize| values[y * width + x0] * (1.0 - fx) + values[y * width + x1] * fx;
            out.push(row(y0) * (1.0 - fy) + row(y1) * fy);
        }
    }
    out
}

/// The two resizing steps of SAM's post-processing, with the padding cropped between them.
fn enlarged(logits: &[f32], letterbox: &Letterbox, logits_px: [u32; 2]) -> Vec<f64> {
    let logits: Vec<f64> = logits.iter().map(|&logit| f64::from(logit)).collect();
    let size = letterbox.size_px as usize;
    let square = bilinear(&logits, logits_px.map(|edge| edge as usize), [size; 2]);
    let [width, height] = letterbox.resized_px.map(|edge| edge as usize);
    let rows = square.chunks_exact(size).take(height);
    let cut: Vec<f64> = rows.flat_map(|row| row[..width].to_vec()).collect();
    bilinear(&cut, [width, height], letterbox.image_px.map(|edge| edge as usize))
}

#[derive(Clone)]
struct Dense {
    inside: Vec<bool>,
    predicted_iou: f64,
    level: u8,
    crop: [i64; 4],
    healed: bool,
}

struct Oracle {
    settings: SamSettings,
    image_px: [usize; 2],
}

impl Oracle {
    /// First and last column and row, as x0, y0, x1, y1.
    fn box_of(&self, inside: &[bool]) -> [i64; 4] {
        let width = self.image_px[0] as i64;
        let pixels = (0..).zip(inside).filter(|(_, inside)| **inside).map(|(at, _)| (at % width, at / width));
        let (x, y): (Vec<i64>, Vec<i64>) = pixels.unzip();
        let least = |values: &[i64]| *values.iter().min().expect("not empty");
        let most = |values: &[i64]| *values.iter().max().expect("not empty");
        [least(&x), least(&y), most(&x), most(&y)]
    }

    fn nms(
        &self,
        masks: Vec<Dense>,
        score: impl Fn(&Dense) -> f64,
        is_same: impl Fn(&Dense, &Dense) -> bool,
    ) -> Vec<Dense> {
        let mut order: Vec<usize> = (0..masks.len()).collect();
        order.sort_by(|&a, &b| score(&masks[b]).partial_cmp(&score(&masks[a])).unwrap().then(a.cmp(&b)));
        let mut gone = vec![false; masks.len()];
        let mut kept = Vec::new();
        for (rank, &a) in order.iter().enumerate() {
            if gone[a] {
                continue;
            }
            kept.push(masks[a].clone());
            for &b in &order[rank + 1..] {
                gone[b] |= is_same(&masks[a], &masks[b]);
            }
        }
        kept
    }

    fn box_iou(&self, a: &Dense, b: &Dense) -> f64 {
        let (a, b) = (self.box_of(&a.inside), self.box_of(&b.inside));
        let area = |b: [i64; 4]| ((b[2] - b[0]) * (b[3] - b[1])) as f64;
        let both = [a[0].max(b[0]), a[1].max(b[1]), a[2].min(b[2]), a[3].min(b[3])];
        let both = ((both[2] - both[0]).max(0) * (both[3] - both[1]).max(0)) as f64;
        both / (area(a) + area(b) - both)
    }

    /// Components of pixels equal to `of`, by flooding over the eight neighbours.
    fn floods(&self, inside: &[bool], of: bool) -> Vec<Vec<usize>> {
        let [width, height] = self.image_px;
        let mut seen = vec![false; inside.len()];
        let mut floods = Vec::new();
        for start in 0..inside.len() {
            if seen[start] || inside[start] != of {
                continue;
            }
            let (mut flood, mut open) = (Vec::new(), vec![start]);
            seen[start] = true;
            while let Some(at) = open.pop() {
                flood.push(at);
                let (x, y) = ((at % width) as i64, (at / width) as i64);
                for (dx, dy) in [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)] {
                    let (x, y) = (x + dx, y + dy);
                    if x >= 0 && y >= 0 && x < width as i64 && y < height as i64 {
                        let next = y as usize * width + x as usize;
                        if !seen[next] && inside[next] == of {
                            seen[next] = true;
                            open.push(next);
                        }
                    }
                }
            }
            floods.push(flood);
        }
        floods
    }

    fn heal(&self, mask: &mut Dense) {
        let least = self.settings.min_region_px as usize;
        for hole in self.floods(&mask.inside, false).iter().filter(|hole| hole.len() < least) {
            hole.iter().for_each(|&at| mask.inside[at] = true);
            mask.healed = true;
        }
        let islands = self.floods(&mask.inside, true);
        let small: Vec<_> = islands.iter().filter(|island| island.len() < least).collect();
        if small.is_empty() {
            return;
        }
        mask.healed = true;
        let spared = (small.len() == islands.len()).then(|| {
            // The first of the largest.
            islands.iter().rev().max_by_key(|island| island.len()).expect("not empty")
        });
        for island in small.into_iter().filter(|island| Some(*island) != spared) {
            island.iter().for_each(|&at| mask.inside[at] = false);
        }
    }

    fn of_crop(&self, blobs: &[Blob], letterbox: &Letterbox, crop: BoxPx) -> Vec<Dense> {
        let settings = &self.settings;
        let [width, height] = self.image_px;
        let crop = [crop.x0, crop.y0, crop.x1, crop.y1].map(i64::from);
        let mut masks = Vec::new();
        for (at, blob) in blobs.iter().enumerate() {
            if blob.predicted_iou <= settings.predicted_iou {
                continue;
            }
            let dense = enlarged(&logits(blob), letterbox, [LOGITS_PX; 2]);
            let n_above = |limit: f64| dense.iter().filter(|logit| **logit > limit).count() as f64;
            let offset = f64::from(settings.stability_offset);
            if n_above(0.0) == 0.0 || n_above(offset) / n_above(-offset) < settings.stability {
                continue;
            }
            let mut inside = vec![false; width * height];
            for (at, logit) in dense.iter().enumerate() {
                let (x, y) = (at % letterbox.image_px[0] as usize, at / letterbox.image_px[0] as usize);
                inside[(y + crop[1] as usize) * width + x + crop[0] as usize] = *logit > 0.0;
            }
            let found = self.box_of(&inside);
            let image = [0, 0, width as i64, height as i64];
            if (0..4).any(|k| (found[k] - crop[k]).abs() <= 20 && (found[k] - image[k]).abs() > 20) {
                continue;
            }
            let level = [2, 1, 0][at % 3];
            let predicted_iou = blob.predicted_iou.into();
            masks.push(Dense { inside, predicted_iou, level, crop, healed: false });
        }
        self.nms(masks, |mask| mask.predicted_iou, |a, b| self.box_iou(a, b) > settings.box_nms_iou)
    }

    fn of_image(&self, mut masks: Vec<Dense>, n_crops: usize) -> Vec<Dense> {
        let settings = &self.settings;
        if n_crops > 1 {
            let area = |mask: &Dense| ((mask.crop[2] - mask.crop[0]) * (mask.crop[3] - mask.crop[1])) as f64;
            masks =
                self.nms(masks, |mask| 1.0 / area(mask), |a, b| self.box_iou(a, b) > settings.crop_nms_iou);
        }
        if settings.min_region_px > 0 {
            masks.iter_mut().for_each(|mask| self.heal(mask));
            let most = settings.box_nms_iou.max(settings.crop_nms_iou);
            masks =
                self.nms(masks, |mask| if mask.healed { 0.0 } else { 1.0 }, |a, b| self.box_iou(a, b) > most);
        }
        if settings.mask_nms_iou < 1.0 {
            let iou = |a: &Dense, b: &Dense| {
                let pairs = || a.inside.iter().zip(&b.inside);
                pairs().filter(|(a, b)| **a && **b).count() as f64
                    / pairs().filter(|(a, b)| **a || **b).count() as f64
            };
            masks = self.nms(masks, |mask| mask.predicted_iou, |a, b| iou(a, b) > settings.mask_nms_iou);
        }
        masks
    }
}

/// Compares the filters with the recomputation; returns the number of kept masks.
fn compare(settings: SamSettings, image_px: [u32; 2], n_prompts: usize, seed: u64) -> usize {
    let filters = Filters { settings: &settings, image_px };
    let oracle = Oracle { settings: settings.clone(), image_px: image_px.map(|edge| edge as usize) };
    let crops = points::crops(image_px[0], image_px[1], settings.crop_layers, settings.crop_overlap);
    let (mut found, mut expected) = (Vec::new(), Vec::new());
    for (number, (crop, _)) in crops.iter().enumerate() {
        let letterbox = Letterbox::new(SIZE_PX, [crop.width_px(), crop.height_px()]);
        let all = blobs(n_prompts, seed + number as u64, letterbox.resized_px.map(f64::from));
        let mut candidates = Vec::new();
        for batch in all.chunks(3 * 8) {
            let decoded = decoded(batch);
            let upsampler = Upsampler::new(&letterbox, decoded.logits_px);
            candidates.extend(filters.candidates(&decoded, &upsampler, *crop));
        }
        found.extend(filters.unique_in_crop(candidates));
        expected.extend(oracle.of_crop(&all, &letterbox, *crop));
    }
    let found: Vec<Mask> = filters
        .unique_in_image(found, crops.len())
        .iter()
        .map(|candidate| candidate.mask.to_mask(candidate.level))
        .collect();
    let expected = oracle.of_image(expected, crops.len());
    assert_eq!(found.len(), expected.len(), "{settings:?}");
    for (k, (found, expected)) in found.iter().zip(&expected).enumerate() {
        let pixels = (0..image_px[1]).flat_map(|y| (0..image_px[0]).map(move |x| (x, y)));
        let inside: Vec<bool> = pixels.map(|(x, y)| found.contains(x, y)).collect();
        assert!(inside == expected.inside, "mask {k} of {settings:?}");
        assert_eq!(found.level, expected.level, "mask {k} of {settings:?}");
        assert_eq!(found.area_px as usize, inside.iter().filter(|inside| **inside).count());
    }
    found.len()
}

fn without_filters() -> SamSettings {
    SamSettings { predicted_iou: 0.0, stability: 0.0, box_nms_iou: 1.0, ..SamSettings::default() }
}

#[test]
fn the_filters_equal_a_plain_recomputation() {
    let all = without_filters();
    let image_px = [230, 170];
    let n = |settings: &SamSettings| compare(settings.clone(), image_px, 24, 7);
    let n_all = n(&all);
    assert!(n_all > 50, "{n_all}");
    // Each filter alone drops something, and so do all together.
    for settings in [
        SamSettings { predicted_iou: 0.88, ..all.clone() },
        SamSettings { stability: 0.9, ..all.clone() },
        SamSettings { stability: 0.6, stability_offset: 2.0, ..all.clone() },
        SamSettings { box_nms_iou: 0.7, ..all.clone() },
        SamSettings { mask_nms_iou: 0.8, ..all.clone() },
        SamSettings { min_region_px: 120, box_nms_iou: 0.7, crop_nms_iou: 0.6, ..all.clone() },
        SamSettings { stability: 0.8, mask_nms_iou: 0.9, min_region_px: 60, ..SamSettings::default() },
    ] {
        let n_kept = n(&settings);
        println!("{n_kept} of {n_all}: {settings:?}");
        assert!(n_kept > 0 && n_kept < n_all);
    }
    // Regions are healed even if every island is small.
    assert_eq!(n(&SamSettings { min_region_px: 1_000_000, crop_nms_iou: 1.0, ..all.clone() }), n_all);
}

/// Outlines, holes and rough places lie along blocks that are enlarged, beside others that are not.
#[test]
fn rough_masks_equal_a_plain_recomputation() {
    let letterbox = Letterbox::new(SIZE_PX, [300, 200]);
    let upsampler = Upsampler::new(&letterbox, [LOGITS_PX; 2]);
    let random = &mut Random::new(8);
    assert!(upsampler.cut(&[f32::NAN; (LOGITS_PX * LOGITS_PX) as usize], 1.0, [0, 0]).is_none());
    let mut n_inside = 0;
    for (n, blob) in blobs(20, 17, [256.0, 170.0]).iter().enumerate() {
        let rough = [0.0, 2.0, 40.0][n % 3];
        let mut logits = logits(blob);
        logits.iter_mut().for_each(|logit| *logit += (rough * (random.unit() - 0.5)) as f32);
        let values = enlarged(&logits, &letterbox, [LOGITS_PX; 2]);
        let n_above = |limit: f64| values.iter().filter(|value| **value > limit).count() as f64;
        let Some(cut) = upsampler.cut(&logits, 1.0, [0, 0]) else {
            assert_eq!(n_above(1e-4), 0.0);
            continue;
        };
        assert!((cut.stability - n_above(1.0) / n_above(-1.0)).abs() < 1e-3, "{n}: {}", cut.stability);
        let mask = cut.mask.to_mask(0);
        let mut inside = vec![false; values.len()];
        for (at, inside) in inside.iter_mut().enumerate() {
            *inside = mask.contains(at as u32 % 300, at as u32 / 300);
        }
        for (at, (inside, value)) in inside.iter().zip(&values).enumerate() {
            assert!(*inside == (*value > 0.0) || value.abs() < 1e-4, "{n}: pixel {at} has {value}");
        }
        n_inside += mask.area_px;
    }
    assert!(n_inside > 100_000, "{n_inside}");
}

/// The identity decides whether an encode may resume: other files or settings make another segmenter.
#[needs_shared]
fn the_identity_holds_model_and_settings() {
    let segmenter = tiny(SamSettings::default());
    let other = tiny(SamSettings { crop_points_divisor: 2, ..SamSettings::default() });
    let identity = segmenter.identity();
    assert_ne!(identity, other.identity());
    for part in ["38dc63289500", "68f6ab0a5d54", "1024 px", "predicted_iou: 0.88", "1 threads"] {
        assert!(identity.contains(part), "{part}: {identity}");
    }
}

/// Noise contains all neighbourhoods of pixels, including contacts at corners.
#[test]
fn healing_of_noise_equals_a_plain_recomputation() {
    let mut random = Random::new(5);
    for round in 0..300 {
        let [width, height] = [1 + round % 19, 1 + round % 13];
        let density = 0.2 + 0.6 * random.unit();
        let inside: Vec<bool> = (0..width * height).map(|_| random.unit() < density).collect();
        let min_region_px = (random.unit() * 12.0) as u32;
        let mut runs = Vec::new();
        for (y, row) in inside.chunks_exact(width).enumerate() {
            // Runs must be disjoint: each begins after a pixel outside.
            for x0 in (0..width).filter(|&x| row[x] && (x == 0 || !row[x - 1])) {
                let x1 = (x0..width).find(|&x| !row[x]).unwrap_or(width);
                runs.push(Run { y: y as u32, x0: x0 as u32, x1: x1 as u32 });
            }
        }
        let Some(mask) = RunMask::new(runs) else { continue };
        let settings = SamSettings { min_region_px, ..SamSettings::default() };
        let oracle = Oracle { settings, image_px: [width, height] };
        let mut expected = Dense { inside, predicted_iou: 0.0, level: 0, crop: [0; 4], healed: false };
        oracle.heal(&mut expected);
        let healed = mask.without_small_regions(width as u32, height as u32, min_region_px);
        assert_eq!(healed.is_some(), expected.healed, "round {round}");
        let found = healed.unwrap_or(mask).to_mask(0);
        for (at, inside) in expected.inside.iter().enumerate() {
            assert_eq!(found.contains((at % width) as u32, (at / width) as u32), *inside, "round {round}");
        }
    }
}

#[test]
fn crops_equal_a_plain_recomputation() {
    let all = SamSettings { crop_nms_iou: 1.0, ..without_filters() };
    for (crop_layers, image_px) in [(1, [300, 211]), (2, [181, 260])] {
        let settings = SamSettings { crop_layers, ..all.clone() };
        let n_all = compare(settings.clone(), image_px, 8, 3);
        let n_kept = compare(SamSettings { crop_nms_iou: 0.5, ..settings.clone() }, image_px, 8, 3);
        assert!(n_kept > 3 && n_kept < n_all, "{n_kept} of {n_all}");
    }
}

fn tiny(settings: SamSettings) -> SamSegmenter {
    let session = SessionOptions::new(onnx_runtime());
    SamSegmenter::open(&workspace_root().join("tests/models/sam_tiny"), settings, &session, &[0])
        .expect("it opens")
}

/// Recorded results of `SamImageProcessor.post_process_masks`.
#[needs_shared]
fn enlarged_masks_equal_the_recorded_ones() {
    let segmenter = tiny(SamSettings::default());
    let golden = shared("models/sam_tiny/golden.npz");
    let (shape, levels) = array::<u8>(&golden, "image");
    let photo = image::RgbImage::from_raw(shape[1] as u32, shape[0] as u32, levels).expect("RGB");
    let embedding = segmenter.lanes.take().embed(&photo).expect("it runs");
    let (_, points) = array::<f32>(&golden, "input_points");
    let (_, labels) = array::<i64>(&golden, "input_labels");
    let decoded = segmenter.lanes.take().decode(&embedding, 3, points.as_chunks::<2>().0, &labels).unwrap();
    let (shape, recorded) = array::<u8>(&golden, "masks_original_size");
    let upsampler = Upsampler::new(&embedding.letterbox, decoded.logits_px);
    let n_logits = (decoded.logits_px[0] * decoded.logits_px[1]) as usize;
    let (width, stride) = (photo.width() as usize, shape[3]);
    let (mut n_inside, mut n_differing) = (0, 0);
    for (k, logits) in decoded.logits.chunks_exact(n_logits).enumerate() {
        let mask = upsampler.cut(logits, 0.0, [0, 0]).map(|cut| cut.mask.to_mask(0));
        let dense = enlarged(logits, &embedding.letterbox, decoded.logits_px);
        for (at, logit) in dense.iter().enumerate() {
            let (x, y) = (at % width, at / width);
            let byte = recorded[(k * photo.height() as usize + y) * stride + x / 8];
            let expected = byte & (0x80 >> (x % 8)) != 0;
            let found = mask.as_ref().is_some_and(|mask| mask.contains(x as u32, y as u32));
            n_inside += u32::from(found);
            // Runtimes differ by 2e-6.
            if found != expected {
                assert!(logit.abs() < 1e-5, "mask {k} at {x} {y}: {logit}");
                n_differing += 1;
            }
        }
    }
    println!("{n_differing} pixels differ of {n_inside} inside");
    assert!(n_inside > 10_000 && n_differing < 5, "{n_inside} {n_differing}");
}

/// An overflowing pixel value gives NaN behind the model, as with models in half precision.
#[needs_shared]
fn masks_that_are_no_numbers_fail_the_view() {
    let from = workspace_root().join("tests/models/sam_tiny");
    let description = fs_err::read_to_string(from.join("model.toml")).expect("readable");
    let dir = tempfile::tempdir().expect("a folder");
    fs_err::create_dir(dir.path().join("sam_tiny")).expect("made");
    for file in ["vision_encoder.onnx", "prompt_encoder_mask_decoder.onnx"] {
        fs_err::copy(shared("models/sam_tiny").join(file), dir.path().join("sam_tiny").join(file))
            .expect("copies");
    }
    let wrong = description.replace("../../../../shared/models", ".") + "\nstd = [1e-300, 1e-300, 1e-300]\n";
    fs_err::write(dir.path().join("model.toml"), wrong).expect("writes");
    let session = SessionOptions::new(onnx_runtime());
    let segmenter = SamSegmenter::open(dir.path(), SamSettings::default(), &session, &[0]).expect("opens");
    let loaded = LoadedImage {
        view: View {
            name: "a.jpg".into(),
            image_path: "a.jpg".into(),
            intrinsics: crate::raster::pinhole([64, 48], 60.0),
            camera_from_world: glam::DAffine3::IDENTITY,
        },
        image: image::RgbImage::from_pixel(64, 48, image::Rgb([200; 3])),
        undistorter: None,
        valid: None,
        oddity: None,
    };
    let error = segmenter.segment(&SegmentInput::new(&loaded, None)).expect_err("no numbers").to_string();
    assert!(error.contains("view a.jpg: the mask model's output is not finite"), "{error}");
}
