//! The built-in stand-in: recognises colours and coarse shapes, not objects; needs no files and no ONNX Runtime.
//!
//! An image's vector is a soft histogram over the 11 basic colour terms (Berlin and Kay 1969), then shape terms
//! from the mask. A text's vector is the sum of its words' prototypes; colour prototypes are centred, so that an
//! absent colour scores below 0.
//!
//! Pixels are judged in OKLab (Ottosson 2020). Shade multiplies linear light by k, and so L, a and b by the cube
//! root of k: hue and chroma / L are invariant and decide between hues. Lightness, relative to the crop's
//! highlights, matters only for names that depend on it (white, grey, black; orange, brown; red, pink).

use std::sync::LazyLock;

use slag_math::stats::{Rank, quantile};

use crate::encoder::{Crop, ImageEncoder, TextEncoder, normalise};
use crate::error::InferenceError;

pub const NAME: &str = "colour-shape-v1";

pub const ABOUT: &str = "built-in stand-in: knows 11 colours and 3 shapes, no objects";

/// Least cosine of a match: an object with the colour on half of its pixels passes (0.5 or more), on a fifth does not.
pub const THRESHOLD: f32 = 0.35;

const COLOURS: [&str; 11] =
    ["black", "white", "grey", "red", "green", "blue", "yellow", "orange", "brown", "pink", "purple"];
const N_COLOURS: usize = COLOURS.len();

/// Indices into [`COLOURS`].
#[derive(Clone, Copy, PartialEq, Eq)]
enum Colour {
    Black,
    White,
    Grey,
    Red,
    Green,
    Blue,
    Yellow,
    Orange,
    Brown,
    Pink,
    Purple,
}

const SHAPES: [&str; 3] = ["tall", "wide", "round"];

/// Components of a vector: one for each colour and each shape.
pub const DIM: usize = N_COLOURS + SHAPES.len();

/// Length of a full shape term, with colours of length at most 1: an object of one colour then scores 0.45 for its
/// shape, above the threshold, and 0.88 for its colour.
const SHAPE_WEIGHT: f32 = 0.5;

/// Other words, each before the one that it means.
const SYNONYMS: &str = "gray grey, silver grey, dark black, scarlet red, crimson red, lime green, navy blue, azure blue, \
    gold yellow, golden yellow, amber orange, beige brown, tan brown, wooden brown, magenta pink, rose pink, violet purple, \
    lilac purple, upright tall, vertical tall, horizontal wide, flat wide, circular round, ball-shaped round";

/// Words that say nothing about colour or shape.
const STOP_WORDS: &str = "a an the and or of with in is are that this some any all thing things object objects item items \
    coloured colored photo something anything everything one ones find where there";

fn known() -> Vec<String> {
    COLOURS.iter().chain(&SHAPES).map(|&word| word.to_owned()).collect()
}

#[derive(Clone, Copy, Debug, Default)]
pub struct ColourShape;

impl TextEncoder for ColourShape {
    fn dim(&self) -> usize {
        DIM
    }

    fn nouns(&self) -> Option<&[String]> {
        static WORDS: LazyLock<Vec<String>> = LazyLock::new(known);
        Some(&WORDS)
    }

    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError> {
        let text = text.to_lowercase();
        let words = text.split(|c: char| !c.is_alphanumeric() && c != '-').filter(|w| !w.is_empty());
        let mut vector = vec![0.0; DIM];
        let mut unknown = Vec::new();
        let mut is_empty = true;
        for word in words {
            is_empty = false;
            let mut synonyms = SYNONYMS.split(", ").filter_map(|pair| pair.split_once(' '));
            let term = synonyms.find(|(other, _)| *other == word).map_or(word, |(_, term)| term);
            if let Some(colour) = COLOURS.iter().position(|&c| c == term) {
                for (i, x) in vector[..N_COLOURS].iter_mut().enumerate() {
                    *x += f32::from(u8::from(i == colour)) - 1.0 / N_COLOURS as f32;
                }
            } else if let Some(shape) = SHAPES.iter().position(|&s| s == term) {
                vector[N_COLOURS + shape] += 1.0;
            } else if STOP_WORDS.split(' ').all(|stop| stop != word) {
                unknown.push(word.to_owned());
            }
        }
        if is_empty {
            return Err(InferenceError::EmptyText);
        }
        // All colours together cancel out, as do stop words alone.
        if !unknown.is_empty() || !normalise(&mut vector) {
            return Err(InferenceError::UnknownWords { unknown, known: known() });
        }
        Ok(vector)
    }
}

impl ImageEncoder for ColourShape {
    fn dim(&self) -> usize {
        DIM
    }

    fn preferred_batch(&self) -> usize {
        16
    }

    fn encode(&mut self, crops: &[Crop]) -> Result<Vec<f32>, InferenceError> {
        let mut vectors = Vec::with_capacity(crops.len() * DIM);
        for (index, crop) in crops.iter().enumerate() {
            vectors.extend(encode_crop(crop).ok_or(InferenceError::EmptyCrop { index })?);
        }
        Ok(vectors)
    }
}

struct Pixel {
    lightness: f32,
    /// Chroma over lightness.
    saturation: f32,
    hue_deg: f32,
}

/// Pixels sampled per crop; more would not change the histogram.
const MAX_SAMPLES: usize = 1 << 14;

fn encode_crop(crop: &Crop) -> Option<[f32; DIM]> {
    let inside: Vec<usize> =
        crop.inside().iter().enumerate().filter_map(|(i, &is_inside)| is_inside.then_some(i)).collect();
    let stride = inside.len().div_ceil(MAX_SAMPLES).max(1);
    let linear_of_level: [f32; 256] = std::array::from_fn(linear_from_srgb);
    let levels = crop.image().as_raw();
    let pixels: Vec<Pixel> = inside
        .iter()
        .step_by(stride)
        .map(|&i| oklab([0, 1, 2].map(|channel| linear_of_level[usize::from(levels[i * 3 + channel])])))
        .collect();
    let mut lightness: Vec<f32> = pixels.iter().map(|p| p.lightness).collect();
    // The 90th percentile ignores a glint on a dark object.
    let highlight = quantile(&mut lightness, 900, Rank::After)?;

    let mut vector = [0.0; DIM];
    for pixel in &pixels {
        add_colours(pixel, highlight, &mut vector[..N_COLOURS]);
    }
    vector[..N_COLOURS].iter_mut().for_each(|x| *x /= pixels.len() as f32);
    for (x, term) in vector[N_COLOURS..].iter_mut().zip(shape(&inside, crop.image().width() as usize)) {
        *x = SHAPE_WEIGHT * term;
    }
    normalise(&mut vector).then_some(vector)
}

/// sRGB's transfer function (IEC 61966-2-1).
fn linear_from_srgb(level: usize) -> f32 {
    let x = level as f32 / 255.0;
    if x <= 0.04045 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) }
}

/// OKLab of linear sRGB; matrices of Ottosson 2020.
fn oklab([r, g, b]: [f32; 3]) -> Pixel {
    let l = (0.412_221_46 * r + 0.536_332_55 * g + 0.051_445_995 * b).cbrt();
    let m = (0.211_903_5 * r + 0.680_699_5 * g + 0.107_396_96 * b).cbrt();
    let s = (0.088_302_46 * r + 0.281_718_85 * g + 0.629_978_7 * b).cbrt();
    let lightness = 0.210_454_26 * l + 0.793_617_8 * m - 0.004_072_047 * s;
    let a = 1.977_998_5 * l - 2.428_592_2 * m + 0.450_593_7 * s;
    let b = 0.025_904_037 * l + 0.782_771_77 * m - 0.808_675_77 * s;
    let saturation = a.hypot(b) / lightness.max(1e-3);
    Pixel { lightness, saturation, hue_deg: b.atan2(a).to_degrees().rem_euclid(360.0) }
}

/// 0 up to `from`, 1 from `to`, linear between.
fn ramp(x: f32, from: f32, to: f32) -> f32 {
    ((x - from) / (to - from)).clamp(0.0, 1.0)
}

/// Hues of the colour terms in OKLab, degrees, the first repeated at the end: those of the sRGB colours of these
/// names, shifted slightly to the middle of each name's range.
const HUES: [(f32, Colour); 8] = [
    (27.0, Colour::Red),
    (62.0, Colour::Orange),
    (103.0, Colour::Yellow),
    (138.0, Colour::Green),
    (255.0, Colour::Blue),
    (315.0, Colour::Purple),
    (358.0, Colour::Pink),
    (387.0, Colour::Red),
];

/// Adds the colour terms of `pixel`, 1 in total, to `shares`; `highlight`: lightness of the crop's lighter pixels.
fn add_colours(pixel: &Pixel, highlight: f32, shares: &mut [f32]) {
    let mut add = |colour: Colour, share: f32| shares[colour as usize] += share;
    let Pixel { lightness, saturation, hue_deg } = *pixel;
    // Photographs tint white walls: a tint below 0.045 still counts as white or grey.
    let chromatic = ramp(saturation, 0.045, 0.09);
    // Navy is darker than the darkest grey that counts as black.
    let darkest = 0.26 - 0.16 * chromatic;
    let lit = ramp(lightness, darkest, darkest + 0.08);
    add(Colour::Black, 1.0 - lit);

    // A third of the way to the highlight: white stays white down to a quarter of the light; grey on white stays grey.
    let relit = lightness + 0.35 * (highlight - lightness).max(0.0);
    let white = ramp(relit, 0.76, 0.84);
    add(Colour::White, lit * (1.0 - chromatic) * white);
    add(Colour::Grey, lit * (1.0 - chromatic) * (1.0 - white));

    let hue_deg = if hue_deg < HUES[0].0 { hue_deg + 360.0 } else { hue_deg };
    let between = HUES.windows(2).find(|pair| hue_deg < pair[1].0).unwrap_or(&HUES[HUES.len() - 2..]);
    let [(from, before), (to, after)] = [between[0], between[1]];
    // A name covers half of the way to each neighbour.
    let towards_after = ramp((hue_deg - from) / (to - from), 0.25, 0.75);
    for (hue, share) in [(before, 1.0 - towards_after), (after, towards_after)] {
        let share = lit * chromatic * share;
        // Names of one hue when dark, dull or light, by the highlight, so that shaded colours keep their name.
        let (other, part) = match hue {
            Colour::Red => {
                let pink = ramp(highlight, 0.68, 0.78) * (1.0 - ramp(saturation, 0.2, 0.3));
                let brown = (1.0 - ramp(highlight, 0.5, 0.6)) * (1.0 - ramp(saturation, 0.3, 0.38));
                if pink > 0.0 { (Colour::Pink, pink) } else { (Colour::Brown, brown) }
            }
            Colour::Orange => {
                (Colour::Brown, (1.0 - ramp(highlight, 0.6, 0.7)).max(1.0 - ramp(saturation, 0.13, 0.17)))
            }
            Colour::Yellow => (Colour::Brown, 1.0 - ramp(saturation, 0.08, 0.12)),
            _ => (hue, 0.0),
        };
        add(hue, share * (1.0 - part));
        add(other, share * part);
    }
}

/// How tall, wide and round a mask is, 0 to 1 each; `inside`: row-major indices, not empty.
fn shape(inside: &[usize], width_px: usize) -> [f32; 3] {
    let n = inside.len() as f64;
    let centre = |i: usize| ((i % width_px) as f64 + 0.5, (i / width_px) as f64 + 0.5);
    let (sum_x, sum_y) = inside.iter().map(|&i| centre(i)).fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
    let from_mean = |i: usize| (centre(i).0 - sum_x / n, centre(i).1 - sum_y / n);
    let mut radii2 = Vec::with_capacity(inside.len());
    // A square pixel has a variance of 1/12; without it, a line one pixel wide would have no width.
    let (mut var_x, mut var_y) = (1.0 / 12.0, 1.0 / 12.0);
    for (x, y) in inside.iter().map(|&i| from_mean(i)) {
        var_x += x * x / n;
        var_y += y * y / n;
        radii2.push(x * x + y * y);
    }
    // Logarithm of height over width; 2.5 is fully tall.
    let elongation = 0.5 * (var_y / var_x).ln() / 2.5f64.ln();
    // Share of the enclosing circle: disc 1, square 0.64, ellipse 2:1 0.5; without the ragged farthest 2 % of pixels.
    let (_, &mut radius2, _) = radii2.select_nth_unstable_by((inside.len() - 1) * 49 / 50, f64::total_cmp);
    let filled = n / (std::f64::consts::PI * (radius2.sqrt() + 0.5).powi(2) / 0.98);
    [elongation.clamp(0.0, 1.0) as f32, (-elongation).clamp(0.0, 1.0) as f32, ramp(filled as f32, 0.75, 0.9)]
}
