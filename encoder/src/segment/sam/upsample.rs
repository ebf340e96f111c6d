//! Upsampling of the decoder's coarse logits to the pixels of an image.
//!
//! SAM enlarges the logits to its input square, crops the padding and scales the rest to the image; both steps are
//! bilinear with aligned pixel centres. They are linear in each axis, so this module combines them into one step with
//! at most three taps per axis, without the intermediate square. SAM 2 enlarges the logits to the image at once.
//!
//! A block is the pixels that depend on the same three by three logits. If these agree on all thresholds, so do its
//! pixels, and only the blocks along outlines are enlarged. This gives the same bits as enlarging all.

use std::ops::Range;

use slag_math::simd::{InstructionSet, Work};
use slag_models::sam::Letterbox;

use super::runs::{Run, RunMask};

struct Axis {
    /// First of three consecutive logits.
    first: Vec<usize>,
    weights: Vec<[f32; 3]>,
}

/// The two input neighbours of output pixel `at`, and the weight of the second, when resizing `n_in` to `n_out` pixels.
/// The source coordinate is (at + 1/2) n_in / n_out - 1/2, clamped to the input.
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

    fn pixels(&self, first: usize) -> Range<usize> {
        self.first.partition_point(|&tap| tap < first)..self.first.partition_point(|&tap| tap <= first)
    }
}

pub(super) struct Upsampler {
    n_columns: usize,
    x: Axis,
    y: Axis,
    /// Columns of pixels of the blocks that begin at each logit.
    columns: Vec<Range<usize>>,
}

/// A mask from thresholded logits.
pub(super) struct Cut {
    /// Pixels with a logit above 0.
    pub(super) mask: RunMask,
    /// IoU between the masks above `+offset` and above `-offset`.
    pub(super) stability: f64,
}

/// Flags of a block's pixels by its logits; neighbours combine with `&`.
const ABOVE: u8 = 1;
const BELOW: u8 = 2;
const MIXED: u8 = 0;

/// Relative margin beyond a threshold at which weighted means of logits are beyond it, too: tenfold the rounding of
/// nine products and their sum.
const ROUNDING: f32 = 1e-5;

impl Upsampler {
    /// `logits_px`: columns and rows of logits, at least 3, at most the size of the square.
    pub(super) fn new(letterbox: &Letterbox, logits_px: [u32; 2]) -> Self {
        let axis = |k: usize| {
            let image_px = letterbox.image_px[k];
            let (square_px, resized_px) = match letterbox.is_stretched {
                true => (image_px, image_px),
                false => (letterbox.size_px, letterbox.resized_px[k]),
            };
            Axis::new(logits_px[k], square_px, resized_px, image_px)
        };
        let (x, n_columns) = (axis(0), logits_px[0] as usize);
        let columns = (0..n_columns - 2).map(|first| x.pixels(first)).collect();
        Self { n_columns, x, y: axis(1), columns }
    }

    /// Enlarges `logits`, `[rows][columns]`, and thresholds them at 0; `None` if the mask is empty. `origin_px` is
    /// added to the pixels' coordinates.
    pub(super) fn cut(&self, logits: &[f32], offset: f32, origin_px: [u32; 2]) -> Option<Cut> {
        InstructionSet::widest().dispatch(Cutting { upsampler: self, logits, offset, origin_px })
    }

    /// Flags of the blocks, `[rows][blocks]`.
    #[inline(always)]
    fn blocks(&self, logits: &[f32], offset: f32) -> Vec<u8> {
        let limit = offset.abs() * (1.0 + ROUNDING) + f32::MIN_POSITIVE;
        let flag = |logit: &f32| (u8::from(*logit > limit) * ABOVE) | (u8::from(*logit < -limit) * BELOW);
        let flags: Vec<u8> = logits.iter().map(flag).collect();
        let n = self.n_columns;
        let mut blocks = Vec::with_capacity(logits.len());
        let mut of_rows = vec![0; n];
        for rows in flags.windows(3 * n).step_by(n) {
            let (a, b, c) = (&rows[..n], &rows[n..2 * n], &rows[2 * n..]);
            of_rows.iter_mut().zip(a).zip(b).zip(c).for_each(|(((of, a), b), c)| *of = a & b & c);
            blocks.extend(of_rows.iter().zip(&of_rows[1..]).zip(&of_rows[2..]).map(|((a, b), c)| a & b & c));
        }
        blocks
    }

    /// Enlarges a row of logits along x, where one of its three rows of blocks is mixed.
    #[inline(always)]
    fn widen(&self, logits: &[f32], rows_of_blocks: &[u8], widened: &mut [f32]) {
        let n_blocks = self.columns.len();
        for (at, columns) in self.columns.iter().enumerate() {
            if rows_of_blocks.chunks_exact(n_blocks).all(|row| row[at] != MIXED) {
                continue;
            }
            let taps = &logits[at..at + 3];
            for (out, weights) in widened[columns.clone()].iter_mut().zip(&self.x.weights[columns.clone()]) {
                *out = taps[0] * weights[0] + taps[1] * weights[1] + taps[2] * weights[2];
            }
        }
    }

    /// Splits a row of blocks into pixels in a row whose blocks have equal flags.
    #[inline(always)]
    fn stretches(&self, blocks: &[u8], found: &mut Vec<(u8, Range<usize>)>) {
        found.clear();
        for (block, pixels) in blocks.iter().zip(&self.columns) {
            match found.last_mut() {
                Some((last, stretch)) if last == block => stretch.end = pixels.end,
                _ => found.push((*block, pixels.clone())),
            }
        }
    }
}

struct Cutting<'a> {
    upsampler: &'a Upsampler,
    logits: &'a [f32],
    offset: f32,
    origin_px: [u32; 2],
}

impl<S> Work<S> for Cutting<'_> {
    type Output = Option<Cut>;

    #[inline(always)]
    fn run(self, _: S) -> Option<Cut> {
        let Self { upsampler, logits, offset, origin_px } = self;
        let Upsampler { n_columns, x, y: rows, columns } = upsampler;
        let blocks = upsampler.blocks(logits, offset);
        if blocks.iter().all(|block| *block == BELOW) {
            return None;
        }
        let (width, n_blocks, n_rows) = (x.first.len(), columns.len(), logits.len() / n_columns);
        let mut widened = vec![0.0; n_rows * width];
        for (at, (row, out)) in
            logits.chunks_exact(*n_columns).zip(widened.chunks_exact_mut(width)).enumerate()
        {
            let of_row = at.saturating_sub(2) * n_blocks..(at + 1).min(n_rows - 2) * n_blocks;
            upsampler.widen(row, &blocks[of_row], out);
        }
        let mut outline = Outline { line: vec![0.0; width], runs: Vec::new(), n_high: 0, n_low: 0, offset };
        let (mut stretches, mut first_of_stretches) = (Vec::new(), None);
        for (y, (&first, weights)) in rows.first.iter().zip(&rows.weights).enumerate() {
            if first_of_stretches != Some(first) {
                upsampler.stretches(&blocks[first * n_blocks..(first + 1) * n_blocks], &mut stretches);
                first_of_stretches = Some(first);
            }
            let taps = [0, 1, 2].map(|tap| &widened[(first + tap) * width..(first + tap + 1) * width]);
            let y = origin_px[1] + y as u32;
            for (block, pixels) in &stretches {
                match *block {
                    ABOVE => outline.fill(y, pixels.clone()),
                    BELOW => (),
                    _ => outline.threshold(y, pixels.clone(), taps, *weights),
                }
            }
        }
        let stability = outline.n_high as f64 / outline.n_low as f64;
        let to_image = |run: Run| Run { x0: origin_px[0] + run.x0, x1: origin_px[0] + run.x1, ..run };
        let runs = outline.runs.into_iter().map(to_image).collect();
        RunMask::new(runs).map(|mask| Cut { mask, stability })
    }
}

/// Pixels above 0 as they are found, row by row.
struct Outline {
    /// Logits of a row, for reuse.
    line: Vec<f32>,
    runs: Vec<Run>,
    /// Pixels above `offset`, and above `-offset`.
    n_high: u64,
    n_low: u64,
    offset: f32,
}

impl Outline {
    #[inline(always)]
    fn fill(&mut self, y: u32, pixels: Range<usize>) {
        self.n_high += pixels.len() as u64;
        self.n_low += pixels.len() as u64;
        self.extend(y, pixels);
    }

    /// Enlarges three rows along y and adds the pixels above 0.
    #[inline(always)]
    fn threshold(&mut self, y: u32, pixels: Range<usize>, taps: [&[f32]; 3], weights: [f32; 3]) {
        let [a, b, c] = taps.map(|row| &row[pixels.clone()]);
        let mut line = std::mem::take(&mut self.line);
        let logits = &mut line[..pixels.len()];
        for (((logit, a), b), c) in logits.iter_mut().zip(a).zip(b).zip(c) {
            *logit = a * weights[0] + b * weights[1] + c * weights[2];
        }
        let n_above =
            |limit: f32| u64::from(logits.iter().map(|logit| u32::from(*logit > limit)).sum::<u32>());
        self.n_high += n_above(self.offset);
        self.n_low += n_above(-self.offset);
        for (n, chunk) in logits.chunks(64).enumerate() {
            let bit = |(k, logit): (usize, &f32)| u64::from(*logit > 0.0) << k;
            let mut inside = chunk.iter().enumerate().map(bit).fold(0, |bits, bit| bits | bit);
            while inside != 0 {
                let from = inside.trailing_zeros();
                let to = from + (inside >> from).trailing_ones();
                let x0 = pixels.start + 64 * n;
                self.extend(y, x0 + from as usize..x0 + to as usize);
                inside &= u64::MAX.checked_shl(to).unwrap_or(0);
            }
        }
        self.line = line;
    }

    /// Extends the last run, or begins a new one.
    #[inline(always)]
    fn extend(&mut self, y: u32, pixels: Range<usize>) {
        let (x0, x1) = (pixels.start as u32, pixels.end as u32);
        match self.runs.last_mut() {
            Some(run) if run.y == y && run.x1 == x0 => run.x1 = x1,
            _ => self.runs.push(Run { y, x0, x1 }),
        }
    }
}
