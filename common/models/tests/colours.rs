//! The stand-in on drawn objects with uneven light and noise.

use super::*;
use slag_models::{ImageEncoder, TextEncoder};

fn encoders() -> (Box<dyn ImageEncoder>, Box<dyn TextEncoder>) {
    let (model, options) = (ModelDir::colours(), SessionOptions::new("no-such-library.so".into()));
    (model.image_encoder(&options).unwrap(), model.text_encoder(&options).unwrap())
}

/// The sRGB colour of a surface lit by `light` times full light.
fn lit([r, g, b]: [u8; 3], light: f64) -> Rgb<u8> {
    let level = |level: u8| {
        let x = f64::from(level) / 255.0;
        let linear = if x <= 0.04045 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) } * light;
        let x = if linear <= 0.0031308 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
        (x * 255.0).round().clamp(0.0, 255.0) as u8
    };
    Rgb([level(r), level(g), level(b)])
}

/// An object of `colour`, from full light at the left to 0.35 of it at the right, on a background to be ignored.
fn thing(colour: [u8; 3], width: u32, height: u32, inside: impl Fn(u32, u32) -> bool) -> Crop {
    let mut seed = 1u32;
    let image = RgbImage::from_fn(width, height, |x, y| {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let noise = f64::from(seed >> 24) / 255.0 * 0.1 - 0.05;
        if inside(x, y) {
            lit(colour, 1.0 - 0.65 * f64::from(x) / f64::from(width) + noise)
        } else {
            Rgb([0, 255, 0])
        }
    });
    let mask = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| inside(x, y)).collect();
    Crop::new(image, mask).expect("sizes agree")
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// CSS colours of that name, and typical paints and objects.
const THINGS: [(&str, &[[u8; 3]]); 11] = [
    ("black", &[[12, 12, 12], [35, 32, 30]]),
    ("white", &[[255, 255, 255], [245, 240, 232]]),
    ("grey", &[[128, 128, 128], [105, 105, 105], [112, 128, 140]]),
    ("red", &[[255, 0, 0], [200, 30, 35], [220, 20, 60]]),
    ("green", &[[0, 128, 0], [50, 205, 50], [85, 107, 47]]),
    ("blue", &[[0, 0, 255], [65, 105, 225], [135, 206, 235], [0, 0, 128]]),
    ("yellow", &[[255, 255, 0], [250, 220, 50]]),
    ("orange", &[[255, 165, 0], [255, 120, 0]]),
    ("brown", &[[150, 75, 0], [139, 69, 19], [160, 120, 80]]),
    ("pink", &[[255, 192, 203], [255, 105, 180], [255, 150, 170]]),
    ("purple", &[[128, 0, 128], [75, 0, 130], [148, 0, 211]]),
];

#[test]
fn a_shaded_thing_scores_high_for_its_colour_and_low_for_all_others() {
    let (mut images, mut texts) = encoders();
    let threshold = ModelDir::colours().threshold().expect("stated");
    let mut wrong = Vec::new();
    for (name, colour) in THINGS.iter().flat_map(|(name, colours)| colours.iter().map(move |c| (*name, *c))) {
        let vector = images.encode(&[thing(colour, 60, 60, |_, _| true)]).expect("it encodes");
        for (text, _) in THINGS {
            let score = dot(&vector, &texts.encode(text).expect("it is known"));
            let fits = if text == name { score > 0.6 } else { score < threshold };
            if !fits {
                wrong.push(format!("{name} {colour:?} scores {score:.2} for {text}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn an_absent_colour_scores_below_zero_and_a_present_one_passes() {
    let (mut images, mut texts) = encoders();
    let threshold = ModelDir::colours().threshold().expect("stated");
    let red = [220, 20, 30];
    let vector = images.encode(&[thing(red, 50, 50, |_, _| true)]).expect("it encodes");
    for absent in ["green", "blue", "white", "purple"] {
        assert!(dot(&vector, &texts.encode(absent).expect("it is known")) < 0.0, "{absent}");
    }
    // Half red, half blue.
    let mut halves = thing(red, 50, 50, |_, _| true).image().clone();
    halves.enumerate_pixels_mut().filter(|(x, ..)| *x >= 25).for_each(|(.., p)| *p = Rgb([20, 40, 220]));
    let vector = images.encode(&[Crop::whole(halves)]).expect("it encodes");
    let mut score = |text: &str| dot(&vector, &texts.encode(text).expect("it is known"));
    assert!(score("red") > threshold && score("blue") > threshold && score("green") < 0.0);
    assert!(score("red and blue") > score("red"));
}

#[test]
fn shapes_come_from_the_mask() {
    let (mut images, mut texts) = encoders();
    let threshold = ModelDir::colours().threshold().expect("stated");
    let disc =
        |x: u32, y: u32| (f64::from(x) - 39.5).powi(2) + (f64::from(y) - 39.5).powi(2) < 39.0f64.powi(2);
    let crops = [
        ("tall", thing([0, 0, 255], 20, 80, |_, _| true)),
        ("wide", thing([0, 0, 255], 80, 20, |_, _| true)),
        ("round", thing([0, 0, 255], 80, 80, disc)),
        ("", thing([0, 0, 255], 80, 80, |_, _| true)),
    ];
    for (name, crop) in crops {
        let vector = images.encode(&[crop]).expect("it encodes");
        for text in ["tall", "wide", "round"] {
            let score = dot(&vector, &texts.encode(text).expect("it is known"));
            assert!(if text == name { score > threshold } else { score < 0.1 }, "{name} for {text}: {score}");
        }
        assert!(dot(&vector, &texts.encode("blue").expect("it is known")) > 0.6);
    }
}

#[test]
fn words_combine_and_unknown_ones_are_named() {
    let (_, mut texts) = encoders();
    let red = texts.encode("red").expect("it is known");
    for same in ["a red thing", "RED", "the scarlet object", "red, crimson"] {
        assert_eq!(dot(&texts.encode(same).expect("it is known"), &red).min(0.9999), 0.9999, "{same}");
    }
    assert_eq!(texts.encode("gray").expect("it is known"), texts.encode("grey").expect("it is known"));
    assert_eq!(texts.encode("violet").expect("it is known"), texts.encode("purple").expect("it is known"));
    assert!((dot(&red, &red) - 1.0).abs() < 1e-6);
    match texts.encode("a red chair") {
        Err(InferenceError::UnknownWords { unknown, known }) => {
            assert_eq!(unknown, ["chair"]);
            assert_eq!(known.len(), 14);
        }
        other => panic!("{other:?}"),
    }
    assert!(matches!(texts.encode("the thing"), Err(InferenceError::UnknownWords { .. })));
    assert!(matches!(texts.encode(" ,, "), Err(InferenceError::EmptyText)));
}

#[test]
fn an_empty_mask_is_an_error_and_a_large_one_is_sampled() {
    let (mut images, mut texts) = encoders();
    let empty = Crop::new(RgbImage::new(3, 2), vec![false; 6]).expect("sizes agree");
    let red = thing([255, 0, 0], 2, 1, |_, _| true);
    match images.encode(&[red, empty, Crop::whole(RgbImage::new(0, 0))]) {
        Err(InferenceError::EmptyCrop { index: 1 }) => {}
        other => panic!("{other:?}"),
    }
    assert!(Crop::new(RgbImage::new(3, 2), vec![true; 5]).is_none());
    let large = thing([255, 0, 0], 1000, 700, |_, _| true);
    let vector = images.encode(&[large]).expect("it encodes");
    assert!(dot(&vector, &texts.encode("red").expect("it is known")) > 0.8);
}
