//! Turns a crop into an image model's pixel values: resize, centre crop, normalise.
//!
//! Resampling equals Pillow's `Image.resize` (libImaging/Resample.c: two passes, 8-bit between them, 22-bit
//! fixed-point weights) pixel for pixel, because the models were trained and evaluated with it. Integer arithmetic
//! gives the same result on every machine.

use image::RgbImage;
use serde::{Deserialize, Serialize};

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Resize {
    /// The shorter edge becomes `size_px`, keeping the aspect ratio; the centre is kept (`CLIPImageProcessor`).
    ShortestEdge,
    /// Both edges become `size_px`: nothing is cropped, but the aspect ratio is lost.
    Stretch,
    /// The longer edge becomes `size_px`, keeping the aspect ratio; white fills the rest of the square.
    Pad,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Filter {
    /// Cubic convolution with a = -0.5 (Keys 1981), widened when shrinking; Pillow's `BICUBIC`.
    #[default]
    Bicubic,
    /// A triangle, widened when shrinking; Pillow's `BILINEAR`.
    Bilinear,
}

impl Filter {
    /// Half-width of the filter, in input pixels at scale 1.
    fn support(self) -> f64 {
        match self {
            Self::Bicubic => 2.0,
            Self::Bilinear => 1.0,
        }
    }

    fn weight(self, x: f64) -> f64 {
        match self {
            Self::Bicubic => match x.abs() {
                x if x < 1.0 => (1.5 * x - 2.5) * x * x + 1.0,
                x if x < 2.0 => (((x - 5.0) * x + 8.0) * x - 4.0) * -0.5,
                _ => 0.0,
            },
            Self::Bilinear => (1.0 - x.abs()).max(0.0),
        }
    }
}

/// A part of a resized image, in its pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    pub left_px: u64,
    pub top_px: u64,
    pub width_px: u32,
    pub height_px: u32,
}

/// (x / 255 - mean) / std for every level x, per channel.
pub(crate) fn values_of_levels(mean: [f64; 3], std: [f64; 3]) -> [[f32; 256]; 3] {
    let value = |channel: usize, level: usize| ((level as f64 / 255.0 - mean[channel]) / std[channel]) as f32;
    std::array::from_fn(|c| std::array::from_fn(|level| value(c, level)))
}

#[derive(Clone, Debug, PartialEq)]
pub struct Preprocess {
    size_px: u32,
    resize: Resize,
    filter: Filter,
    /// (x / 255 - mean) / std for every level x, per channel.
    values: [[f32; 256]; 3],
}

impl Preprocess {
    /// `mean` and `std` apply to x / 255, per channel RGB.
    pub fn new(size_px: u32, resize: Resize, filter: Filter, mean: [f64; 3], std: [f64; 3]) -> Self {
        Self { size_px, resize, filter, values: values_of_levels(mean, std) }
    }

    pub fn stretched(&self) -> Self {
        Self { resize: Resize::Stretch, ..self.clone() }
    }

    pub fn size_px(&self) -> u32 {
        self.size_px
    }

    /// a and b of pixel value = a * level + b, per channel RGB.
    pub(crate) fn scale_and_offset(&self) -> ([f32; 3], [f32; 3]) {
        let scale = |of_level: [f32; 256]| (f64::from(of_level[255]) - f64::from(of_level[0])) / 255.0;
        (self.values.map(|of_level| scale(of_level) as f32), self.values.map(|of_level| of_level[0]))
    }

    /// Returns the resized size of an image and the window of it that is kept, which is smaller than the square
    /// only with [`Resize::Pad`]. Neither edge may be 0.
    pub fn plan(&self, width_px: u32, height_px: u32) -> ([u64; 2], Window) {
        let size = u64::from(self.size_px);
        let short = u64::from(width_px.min(height_px));
        // The longer edge is rounded down, as in transformers' get_resize_output_image_size.
        let resized = match self.resize {
            Resize::Stretch => [size, size],
            Resize::ShortestEdge => [width_px, height_px].map(|edge| size * u64::from(edge) / short),
            Resize::Pad => {
                let long = u64::from(width_px.max(height_px));
                [width_px, height_px].map(|edge| ((2 * size * u64::from(edge) + long) / (2 * long)).max(1))
            }
        };
        let [width, height] = resized.map(|edge| edge.min(size));
        let window = Window {
            left_px: (resized[0] - width) / 2,
            top_px: (resized[1] - height) / 2,
            width_px: width as u32,
            height_px: height as u32,
        };
        (resized, window)
    }

    /// Resizes and crops to the model's square. `image` must have pixels.
    pub fn square(&self, image: &RgbImage) -> RgbImage {
        let (resized, window) = self.plan(image.width(), image.height());
        let resized = resample(image, self.filter, resized, window);
        let (width, height) = resized.dimensions();
        if width == self.size_px && height == self.size_px {
            return resized;
        }
        let mut square = RgbImage::from_pixel(self.size_px, self.size_px, image::Rgb([255; 3]));
        let [left, top] = [width, height].map(|edge| i64::from((self.size_px - edge) / 2));
        image::imageops::replace(&mut square, &resized, left, top);
        square
    }

    /// Appends the pixel values of `image`: `[3][size_px][size_px]`. `image` must have pixels.
    pub fn append_pixel_values(&self, image: &RgbImage, values: &mut Vec<f32>) {
        let square = self.square(image);
        for (channel, value_of_level) in self.values.iter().enumerate() {
            values.extend(
                square.as_raw().iter().skip(channel).step_by(3).map(|&x| value_of_level[usize::from(x)]),
            );
        }
    }
}

/// Fractional bits of a weight: with 8-bit levels and some overshoot, a sum fits into 32 bits.
const WEIGHT_BITS: u32 = 32 - 8 - 2;

/// The input pixels of one output pixel, with weights.
struct Taps {
    first: usize,
    weights: Vec<i32>,
}

/// Taps of the output pixels `range` when `n_in` pixels are resized to `n_out`.
fn taps(filter: Filter, n_in: u32, n_out: u64, range: std::ops::Range<u64>) -> Vec<Taps> {
    let scale = f64::from(n_in) / n_out as f64;
    let filter_scale = scale.max(1.0);
    let reach = filter.support() * filter_scale;
    range
        .map(|out| {
            let centre = (out as f64 + 0.5) * scale;
            let first = (centre - reach + 0.5).max(0.0) as usize;
            let end = ((centre + reach + 0.5) as usize).min(n_in as usize);
            let weights: Vec<f64> = (first..end)
                .map(|x| filter.weight((x as f64 - centre + 0.5) * (1.0 / filter_scale)))
                .collect();
            let total: f64 = weights.iter().sum();
            let fixed = |w: &f64| (w / total * f64::from(1 << WEIGHT_BITS)).round() as i32;
            Taps { first, weights: weights.iter().map(fixed).collect() }
        })
        .collect()
}

fn to_level(sum: i32) -> u8 {
    (sum >> WEIGHT_BITS).clamp(0, 255) as u8
}

/// Half a level, so that [`to_level`] rounds.
const HALF: i32 = 1 << (WEIGHT_BITS - 1);

/// Resizes `image` to `resized` (width, height) and returns `window` of it, the only part computed. Neither
/// `image` nor `resized` may be empty; the window must lie within `resized`.
pub fn resample(image: &RgbImage, filter: Filter, resized: [u64; 2], window: Window) -> RgbImage {
    let whole = Window { left_px: 0, top_px: 0, width_px: image.width(), height_px: image.height() };
    if window == whole && resized == [image.width(), image.height()].map(u64::from) {
        return image.clone();
    }
    let columns = window.left_px..window.left_px + u64::from(window.width_px);
    let rows = window.top_px..window.top_px + u64::from(window.height_px);
    let columns = taps(filter, image.width(), resized[0], columns);
    let rows = taps(filter, image.height(), resized[1], rows);
    let first_row = rows.iter().map(|t| t.first).min().unwrap_or(0);
    let end_row = rows.iter().map(|t| t.first + t.weights.len()).max().unwrap_or(0);

    let stride_in = image.width() as usize * 3;
    let mut narrowed = Vec::with_capacity((end_row - first_row) * columns.len() * 3);
    for row in image.as_raw().chunks_exact(stride_in).take(end_row).skip(first_row) {
        for tap in &columns {
            let mut sums = [HALF; 3];
            for (pixel, &weight) in row[tap.first * 3..].chunks_exact(3).zip(&tap.weights) {
                for channel in 0..3 {
                    sums[channel] += i32::from(pixel[channel]) * weight;
                }
            }
            narrowed.extend(sums.map(to_level));
        }
    }

    let stride = columns.len() * 3;
    let mut result = RgbImage::new(window.width_px, window.height_px);
    let mut sums = vec![0; stride];
    for (tap, out) in rows.iter().zip(result.chunks_exact_mut(stride.max(1))) {
        sums.fill(HALF);
        let first = (tap.first - first_row) * stride;
        for (row, &weight) in narrowed[first..].chunks_exact(stride).zip(&tap.weights) {
            sums.iter_mut().zip(row).for_each(|(sum, &x)| *sum += i32::from(x) * weight);
        }
        out.iter_mut().zip(&sums).for_each(|(x, &sum)| *x = to_level(sum));
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: a resize that keeps the aspect ratio, pasted into the centre.
    #[test]
    fn padding_keeps_proportions_and_fills_with_white() {
        for (width, height, inner) in
            [(40, 20, [16, 8]), (10, 31, [5, 16]), (7, 7, [16, 16]), (500, 1, [16, 1])]
        {
            let image = RgbImage::from_fn(width, height, |x, y| {
                image::Rgb([(x * 37 % 200) as u8, (y * 53 % 200) as u8, ((x + y) * 11 % 200) as u8])
            });
            let square = Preprocess::new(16, Resize::Pad, Filter::Bicubic, [0.0; 3], [1.0; 3]).square(&image);
            let whole = Window { left_px: 0, top_px: 0, width_px: inner[0], height_px: inner[1] };
            let plain = resample(&image, Filter::Bicubic, inner.map(u64::from), whole);
            let [left, top] = inner.map(|edge| (16 - edge) / 2);
            for (x, y, pixel) in square.enumerate_pixels() {
                let (u, v) = (x.wrapping_sub(left), y.wrapping_sub(top));
                let expected =
                    if u < inner[0] && v < inner[1] { *plain.get_pixel(u, v) } else { image::Rgb([255; 3]) };
                assert_eq!(*pixel, expected, "{width}x{height} at {x},{y}");
            }
        }
    }
}
