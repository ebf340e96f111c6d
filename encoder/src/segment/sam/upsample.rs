//! Upsampling of the decoder's coarse logits to the pixels of an image.
//!
//! SAM enlarges the logits to its input square, crops the padding and scales the rest to the image; both steps are
//! bilinear with aligned pixel centres. They are linear in each axis, so this module combines them into one step
//! with at most three taps per axis, without the intermediate square. SAM 2 enlarges the logits to the image at
//! once.

use slag_models::sam::Letterbox;

use super::runs::{Run, RunMask};

/// The logits and weights of each pixel along an axis.
struct Axis {
    /// The first of three consecutive logits.
    first: Vec<usize>,
    weights: Vec<[f32; 3]>,
}

/// Returns the two input neighbours of output pixel `at` and the weight of the second, when `n_in` pixels are
/// resized to `n_out`. The source coordinate is (at + 1/2) n_in / n_out - 1/2, clamped to the input.
fn neighbours(at: u32, n_in: u32, n_out: u32) -> ([u32; 2], f64) {
    let source = ((f64::from(at) + 0.5) * f64::from(n_in) / f64::from(n_out) - 0.5).max(0.0);
    let low = (source as u32).min(n_in - 1);
    ([low, (low + 1).min(n_in - 1)], source - f64::from(low))
}

impl Axis {
    fn new(n_logits: u32, size_px: u32, resized_px: u32, image_px: u32) -> Self {
        let mut axis = Self { first: Vec::new(), weights: Vec::new() };
        for at in 0..image_px {
            let (in_square, second) = neighbours(at, resized_px, image_px);
            let mut first = None;
            let mut weights = [0.0_f64; 3];
            for (pixel, weight) in in_square.into_iter().zip([1.0 - second, second]) {
                if weight == 0.0 {
                    continue;
                }
                let (logits, second) = neighbours(pixel, n_logits, size_px);
                // Logits are no finer than the square, so two neighbours in it depend on at most three logits.
                let first = *first.get_or_insert((logits[0] as usize).min(n_logits as usize - 3));
                weights[logits[0] as usize - first] += weight * (1.0 - second);
                weights[logits[1] as usize - first] += weight * second;
            }
            axis.first.push(first.unwrap_or(0));
            axis.weights.push(weights.map(|weight| weight as f32));
        }
        axis
    }

    /// Returns the pixels that depend on any of the logits `first..=last`.
    fn pixels(&self, first: usize, last: usize) -> std::ops::Range<usize> {
        let start = self.first.partition_point(|&tap| tap + 2 < first);
        start..self.first.partition_point(|&tap| tap <= last).max(start)
    }
}

/// Upsampling from logits to the pixels of one image.
pub(super) struct Upsampler {
    n_columns: usize,
    x: Axis,
    y: Axis,
}

/// A mask from thresholded logits.
pub(super) struct Cut {
    /// The pixels with a logit above 0.
    pub(super) mask: RunMask,
    /// IoU between the masks above `+offset` and above `-offset`.
    pub(super) stability: f64,
}

impl Upsampler {
    /// Creates the upsampling for `logits_px` columns and rows of logits: at least 3, at most the size of the
    /// square.
    pub(super) fn new(letterbox: &Letterbox, logits_px: [u32; 2]) -> Self {
        let axis = |k: usize| {
            let image_px = letterbox.image_px[k];
            let (square_px, resized_px) = match letterbox.is_stretched {
                true => (image_px, image_px),
                false => (letterbox.size_px, letterbox.resized_px[k]),
            };
            Axis::new(logits_px[k], square_px, resized_px, image_px)
        };
        Self { n_columns: logits_px[0] as usize, x: axis(0), y: axis(1) }
    }

    /// Enlarges `logits`, `[rows][columns]`, and thresholds them at 0; `None` if the mask is empty. `origin_px` is
    /// added to the coordinates of the pixels.
    pub(super) fn cut(&self, logits: &[f32], offset: f32, origin_px: [u32; 2]) -> Option<Cut> {
        // Weighted means of logits below -offset are below it too, so only the rest must be enlarged.
        let (mut rows, mut columns) = ((usize::MAX, 0), (usize::MAX, 0));
        for (y, row) in logits.chunks_exact(self.n_columns).enumerate() {
            let mut above = row.iter().enumerate().filter(|(_, logit)| **logit > -offset).map(|(x, _)| x);
            if let Some(first) = above.next() {
                rows = (rows.0.min(y), y);
                columns = (columns.0.min(first), columns.1.max(above.next_back().unwrap_or(first)));
            }
        }
        if rows.0 == usize::MAX {
            return None;
        }
        let (ys, xs) = (self.y.pixels(rows.0, rows.1), self.x.pixels(columns.0, columns.1));
        let first_row = self.y.first[ys.clone()].iter().copied().min()?;
        let end_row = self.y.first[ys.clone()].iter().copied().max()? + 3;
        let width = xs.len();
        let mut widened = Vec::with_capacity((end_row - first_row) * width);
        for row in logits.chunks_exact(self.n_columns).take(end_row).skip(first_row) {
            for x in xs.clone() {
                let (taps, weights) = (&row[self.x.first[x]..self.x.first[x] + 3], self.x.weights[x]);
                widened.push(taps[0] * weights[0] + taps[1] * weights[1] + taps[2] * weights[2]);
            }
        }
        let is_inside = |logit: &f32| *logit > 0.0;
        let mut runs = Vec::new();
        let (mut n_high, mut n_low) = (0_u64, 0_u64);
        let mut line = vec![0.0_f32; width];
        for y in ys {
            let weights = self.y.weights[y];
            let at = (self.y.first[y] - first_row) * width;
            let [a, b, c] = [0, 1, 2].map(|tap| &widened[at + tap * width..at + (tap + 1) * width]);
            for (k, logit) in line.iter_mut().enumerate() {
                *logit = a[k] * weights[0] + b[k] * weights[1] + c[k] * weights[2];
            }
            n_high += line.iter().filter(|logit| **logit > offset).count() as u64;
            n_low += line.iter().filter(|logit| **logit > -offset).count() as u64;
            let mut from = 0;
            while let Some(start) = line[from..].iter().position(is_inside).map(|k| from + k) {
                let end =
                    line[start..].iter().position(|logit| !is_inside(logit)).map_or(width, |k| start + k);
                let at = |k: usize| origin_px[0] + (xs.start + k) as u32;
                runs.push(Run { y: origin_px[1] + y as u32, x0: at(start), x1: at(end) });
                from = end;
            }
        }
        let stability = n_high as f64 / n_low as f64;
        RunMask::new(runs).map(|mask| Cut { mask, stability })
    }
}
