//! Crops against a plain recomputation on a labelled view, and vectors of a whole view.

use super::*;
use std::{num::NonZeroUsize, time::Instant};

use slag_encoder::embed::{EmbedError, crop, embed_masks};
use slag_encoder::masks::{Bits, masks_of_labels};
use slag_models::{Crop, ImageEncoder, InferenceError};
use slag_test_support::{onnx_runtime, workspace_root};

struct Labelled {
    photo: RgbImage,
    /// Instance of each pixel.
    labels: Vec<u8>,
    masks: Vec<(u8, Mask)>,
}

fn view(name: &str) -> Labelled {
    let scene = shared("scenes/house_a");
    let photo = image::open(scene.join(format!("images/{name}.jpg"))).expect("it decodes").to_rgb8();
    let labels = image::open(scene.join(format!("gt/masks/{name}.png"))).expect("it decodes").to_luma8();
    assert_eq!(photo.dimensions(), labels.dimensions());
    let labels = labels.into_raw();
    let ids: Vec<u32> = labels.iter().map(|label| u32::from(*label)).collect();
    let masks = masks_of_labels(&ids, photo.width(), 256, u64::MAX).expect("no limit").into_iter();
    let masks = masks.filter(|(_, mask)| mask.area_px >= 200).map(|(id, mask)| (id as u8, mask)).collect();
    Labelled { photo, labels, masks }
}

#[needs_shared]
fn crops_equal_a_plain_recomputation() {
    let Labelled { photo, labels, masks } = view("0000");
    assert!(masks.len() > 5, "{}", masks.len());
    for (id, mask) in &masks {
        let b = mask.box_px;
        let crop = crop(&photo, mask).expect("it fits");
        assert_eq!(crop.image().dimensions(), (b.x1 - b.x0, b.y1 - b.y0));
        for (x, y, found) in crop.image().enumerate_pixels() {
            let in_photo = (x + b.x0, y + b.y0);
            let is_inside = labels[(in_photo.1 * photo.width() + in_photo.0) as usize] == *id;
            let expected = if is_inside { *photo.get_pixel(in_photo.0, in_photo.1) } else { Rgb([255; 3]) };
            assert_eq!(*found, expected, "instance {id}, {x} {y}");
            assert_eq!(crop.inside()[(y * (b.x1 - b.x0) + x) as usize], is_inside);
        }
    }
}

#[needs_shared]
fn vectors_of_a_view_are_the_crops_own_in_any_batch() {
    let Labelled { photo, masks, .. } = view("0000");
    let library = onnx_runtime();
    let model = ModelDir::open(&workspace_root().join("tests/models/conse")).expect("it opens");
    let mut encoder = model.image_encoder(&SessionOptions::new(library)).expect("it loads");
    let masks: Vec<Mask> = masks.into_iter().map(|(_, mask)| mask).collect();
    let start = Instant::now();
    let together = embed_masks(&photo, &masks, None, &mut *encoder, None).expect("it embeds");
    let seconds = start.elapsed().as_secs_f64();
    println!("{} crops: {:.0} crops/s on one thread", masks.len(), masks.len() as f64 / seconds);
    assert_eq!(together.len(), masks.len() * 512);
    for (i, mask) in masks.iter().enumerate() {
        let crop = crop(&photo, mask).expect("it fits");
        assert!(encoder.encode(&[crop]).expect("it encodes") == together[i * 512..][..512], "mask {i}");
    }
    let threes = embed_masks(&photo, &masks, None, &mut *encoder, NonZeroUsize::new(3));
    assert!(threes.expect("it embeds") == together);
    let none = embed_masks(&photo, &[], None, &mut *encoder, None);
    assert_eq!(none.expect("nothing to do"), Vec::<f32>::new());
}

/// Records the crops per call; a vector is a crop's width and height.
struct Recorder {
    batches: Vec<usize>,
}

impl ImageEncoder for Recorder {
    fn dim(&self) -> usize {
        2
    }
    fn preferred_batch(&self) -> usize {
        4
    }
    fn encode(&mut self, crops: &[Crop]) -> Result<Vec<f32>, InferenceError> {
        self.batches.push(crops.len());
        Ok(crops.iter().flat_map(|c| [c.image().width() as f32, c.image().height() as f32]).collect())
    }
}

fn rectangle(x0: u32, y0: u32, x1: u32, y1: u32) -> Mask {
    Mask::whole(BoxPx { x0, y0, x1, y1 })
}

#[test]
fn batches_are_bounded_by_count_and_by_pixels() {
    let photo = RgbImage::new(3000, 3000);
    let mut masks: Vec<Mask> = (1..=5).map(|i| rectangle(0, 0, i, 2)).collect();
    masks.extend((0..3).map(|_| rectangle(0, 0, 3000, 3000)));
    masks.push(rectangle(2999, 2999, 3000, 3000));
    let mut recorder = Recorder { batches: Vec::new() };
    let vectors = embed_masks(&photo, &masks, None, &mut recorder, None).expect("it embeds");
    // 4 by count; a small one and one of 9 million pixels; large ones alone; the rest.
    assert_eq!(recorder.batches, [4, 2, 1, 1, 1]);
    let expected: Vec<f32> =
        masks.iter().flat_map(|m| [m.box_px.width_px() as f32, m.box_px.height_px() as f32]).collect();
    assert_eq!(vectors, expected);
}

/// Squares of 64 masks: only a batch of four is held at a time, besides the crop that is being cut.
#[test]
fn squares_are_held_a_batch_at_a_time() {
    let photo = RgbImage::new(400, 300);
    let masks: Vec<Mask> = (0..64).map(|i| rectangle(i, i, i + 200, i + 200)).collect();
    let preprocess = ModelDir::embedded().expect("opens").preprocess().expect("squares");
    let mut recorder = Recorder { batches: Vec::new() };
    let (vectors, taken) = memory_of(|| embed_masks(&photo, &masks, Some(&preprocess), &mut recorder, None));
    let square_px = preprocess.size_px() as usize;
    assert_eq!(vectors.expect("it embeds"), [square_px as f32; 128]);
    assert_eq!(recorder.batches, [4; 16]);
    // Three colours and the mask, times both sides; twice the crop while it is cut and resized.
    let most_bytes = 4 * 5 * square_px.pow(2) + 4 * 4 * 200 * 200 + 4096 * 4;
    assert!(taken.peak_bytes < most_bytes, "{taken:?}, {most_bytes}");
}

#[test]
fn masks_that_do_not_fit_are_named() {
    let photo = RgbImage::new(10, 8);
    let beyond = rectangle(5, 5, 11, 8);
    let mut short = rectangle(0, 0, 4, 4);
    short.inside = Bits::of(true, 15);
    let mut empty = rectangle(0, 0, 4, 4);
    empty.inside = Bits::of(false, 16);
    let mut reversed = rectangle(0, 0, 4, 4);
    reversed.box_px = BoxPx { x0: 4, y0: 0, x1: 0, y1: 4 };
    for bad in [beyond, short, empty, reversed] {
        let masks = [rectangle(0, 0, 10, 8), bad];
        let mut recorder = Recorder { batches: Vec::new() };
        let error = embed_masks(&photo, &masks, None, &mut recorder, None).expect_err("it must be refused");
        assert!(matches!(error, EmbedError::Mask { index: 1, .. }), "{error}");
        assert!(error.to_string().contains("10x8"), "{error}");
    }
    assert_eq!(crop(&photo, &rectangle(9, 7, 10, 8)).expect("it fits").image().dimensions(), (1, 1));
}
