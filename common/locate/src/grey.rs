//! Grey images, and the few filters that features need.

use std::borrow::Cow;

/// A grey image, row-major, 0..=1.
#[derive(Clone, Debug, PartialEq)]
pub struct Grey {
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
}

/// Radius of a Gaussian kernel in standard deviations: the rest is below 1e-4.
const KERNEL_SIGMAS: f32 = 4.0;

impl Grey {
    /// Luma (ITU-R BT.601) of 8-bit RGB.
    pub fn from_rgb8(width: usize, height: usize, rgb: &[u8]) -> Self {
        assert_eq!(rgb.len(), width * height * 3, "three bytes a pixel");
        let luma = |[r, g, b]: &[u8; 3]| {
            (0.299 * f32::from(*r) + 0.587 * f32::from(*g) + 0.114 * f32::from(*b)) / 255.0
        };
        Self { width, height, values: rgb.as_chunks().0.iter().map(luma).collect() }
    }

    pub(crate) fn mirrored(&self) -> Self {
        let rows = self.values.chunks_exact(self.width.max(1));
        Self { values: rows.flat_map(|row| row.iter().rev().copied()).collect(), ..*self }
    }

    /// Doubles the size (bilinear); pixel (x, y) moves to (2x, 2y).
    pub(crate) fn doubled(&self) -> Self {
        let (width, height) = (self.width * 2, self.height * 2);
        let mut values = vec![0.0; width * height];
        for (y, row) in values.chunks_exact_mut(width).enumerate() {
            let above = &self.values[y / 2 * self.width..][..self.width];
            let below = &self.values[(y / 2 + y % 2).min(self.height - 1) * self.width..][..self.width];
            for (x, out) in row.as_chunks_mut::<2>().0.iter_mut().enumerate() {
                let right = (x + 1).min(self.width - 1);
                let column = |x: usize| 0.5 * (above[x] + below[x]);
                *out = [column(x), 0.5 * (column(x) + column(right))];
            }
        }
        Self { width, height, values }
    }

    pub(crate) fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut values = Vec::with_capacity(width * height);
        for y in 0..height {
            values.extend((0..width).map(|x| self.values[2 * y * self.width + 2 * x]));
        }
        Self { width, height, values }
    }

    /// Means of 2 x 2 pixels; an odd last row or column is dropped.
    fn halved_by_mean(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut values = Vec::with_capacity(width * height);
        for y in 0..height {
            let [above, below] = [0, 1].map(|row| &self.values[(2 * y + row) * self.width..][..self.width]);
            let pairs = above.as_chunks::<2>().0.iter().zip(below.as_chunks::<2>().0);
            values.extend(pairs.map(|([a, b], [c, d])| 0.25 * (a + b + c + d)));
        }
        Self { width, height, values }
    }

    /// Halves the image until it has at most `max_px` pixels; returns the width of a resulting pixel in original ones.
    pub(crate) fn limited(&self, max_px: usize) -> (Cow<'_, Self>, u32) {
        let (mut picture, mut factor) = (Cow::Borrowed(self), 1);
        while picture.values.len() > max_px {
            picture = Cow::Owned(picture.halved_by_mean());
            factor *= 2;
        }
        (picture, factor)
    }

    /// Gaussian blur; borders are repeated.
    pub(crate) fn blurred(&self, sigma: f32) -> Self {
        let radius = (KERNEL_SIGMAS * sigma).ceil() as usize;
        let weight = |i: usize| (-0.5 * (i as f32 / sigma).powi(2)).exp();
        let mut kernel: Vec<f32> = (0..=radius).map(weight).collect();
        let sum = kernel[0] + 2.0 * kernel[1..].iter().sum::<f32>();
        kernel.iter_mut().for_each(|w| *w /= sum);
        let Self { width, height, ref values } = *self;
        let mut across = vec![0.0f32; width * height];
        let mut padded = vec![0.0f32; width + 2 * radius];
        for (row, out) in values.chunks_exact(width).zip(across.chunks_exact_mut(width)) {
            padded[..radius].fill(row[0]);
            padded[radius..][..width].copy_from_slice(row);
            padded[radius + width..].fill(row[width - 1]);
            for (i, weight) in kernel.iter().enumerate() {
                let (left, right) = (&padded[radius - i..][..width], &padded[radius + i..][..width]);
                // The middle counts once.
                let weight = if i == 0 { weight * 0.5 } else { *weight };
                out.iter_mut().zip(left).zip(right).for_each(|((o, l), r)| *o += weight * (l + r));
            }
        }
        let mut blurred = vec![0.0f32; width * height];
        for (y, out) in blurred.chunks_exact_mut(width).enumerate() {
            for (i, weight) in kernel.iter().enumerate() {
                let above = &across[y.saturating_sub(i) * width..][..width];
                let below = &across[(y + i).min(height - 1) * width..][..width];
                let weight = if i == 0 { weight * 0.5 } else { *weight };
                out.iter_mut().zip(above).zip(below).for_each(|((o, a), b)| *o += weight * (a + b));
            }
        }
        Self { width, height, values: blurred }
    }
}
