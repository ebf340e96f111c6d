//! Orientation and descriptor of a keypoint (Lowe 2004, 5 and 6).

use std::f32::consts::TAU;

use crate::grey::Grey;

/// Length of a descriptor: 4 x 4 cells, 8 directions.
pub const DIM: usize = PLACES * PLACES * DIRECTIONS;
/// RootSIFT (Arandjelovic and Zisserman 2012): the square root of each share of a SIFT descriptor; of length 1.
pub type Descriptor = [f32; DIM];

const PLACES: usize = 4;
const DIRECTIONS: usize = 8;
const ORIENTATION_BINS: usize = 36;
/// Share of the highest peak from which another peak gives the keypoint another orientation.
const OTHER_PEAK: f32 = 0.8;
/// Standard deviation of the orientation window, in the keypoint's.
const ORIENTATION_WINDOW: f32 = 1.5;
/// Width of a cell, in the keypoint's standard deviations (Lowe's code; Vedaldi and Fulkerson 2008).
const PLACE_WIDTH: f32 = 3.0;
/// Largest share of one number, which limits the effect of highlights.
const MAX_SHARE: f32 = 0.2;

/// An extremum, in pixels of its octave.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Keypoint {
    pub(crate) x: f32,
    pub(crate) y: f32,
    /// The blurred image nearest in scale.
    pub(crate) layer: usize,
    /// Blur, pixels of the octave.
    pub(crate) sigma: f32,
    pub(crate) contrast: f32,
}

/// Length and direction (0..TAU) of the gradient at a pixel.
fn gradient(layer: &Grey, x: usize, y: usize) -> (f32, f32) {
    let at = y * layer.width + x;
    let dx = layer.values[at + 1] - layer.values[at - 1];
    let dy = layer.values[at + layer.width] - layer.values[at - layer.width];
    ((dx * dx + dy * dy).sqrt(), dy.atan2(dx).rem_euclid(TAU))
}

/// Returns the pixels within `radius` of a keypoint that have a gradient: offsets and indices.
fn around(layer: &Grey, keypoint: &Keypoint, radius: f32) -> impl Iterator<Item = (f32, f32, usize, usize)> {
    let range = |at: f32, n: usize| {
        let first = (at - radius).ceil().max(1.0) as usize;
        first..=((at + radius).floor() as usize).min(n - 2)
    };
    let (cx, cy) = (keypoint.x, keypoint.y);
    let columns = range(cx, layer.width);
    range(cy, layer.height)
        .flat_map(move |y| columns.clone().map(move |x| (x as f32 - cx, y as f32 - cy, x, y)))
}

/// Returns the peaks of the gradient histogram around a keypoint.
pub(crate) fn orientations(layer: &Grey, keypoint: &Keypoint) -> Vec<f32> {
    let window = ORIENTATION_WINDOW * keypoint.sigma;
    let mut bins = [0.0f32; ORIENTATION_BINS];
    for (dx, dy, x, y) in around(layer, keypoint, 3.0 * window) {
        let (length, angle) = gradient(layer, x, y);
        let weight = (-0.5 * (dx * dx + dy * dy) / (window * window)).exp();
        let bin = (angle / TAU * ORIENTATION_BINS as f32).round() as usize % ORIENTATION_BINS;
        bins[bin] += weight * length;
    }
    let n = ORIENTATION_BINS;
    // Smoothed by (1, 4, 6, 4, 1) / 16, like Lowe's code.
    let smooth: [f32; ORIENTATION_BINS] = std::array::from_fn(|i| {
        let at = |step: usize| bins[(i + step) % n];
        (at(0) * 6.0 + (at(1) + at(n - 1)) * 4.0 + at(2) + at(n - 2)) / 16.0
    });
    let highest = smooth.iter().copied().fold(0.0, f32::max);
    let mut found = Vec::new();
    for i in 0..n {
        let (before, at, after) = (smooth[(i + n - 1) % n], smooth[i], smooth[(i + 1) % n]);
        if at > before && at > after && at >= OTHER_PEAK * highest {
            // Peak of the parabola through the three.
            let peak = i as f32 + 0.5 * (before - after) / (before - 2.0 * at + after);
            found.push((peak / n as f32 * TAU).rem_euclid(TAU));
        }
    }
    found
}

pub(crate) fn describe(layer: &Grey, keypoint: &Keypoint, angle: f32) -> Descriptor {
    let (sin, cos) = angle.sin_cos();
    let place = PLACE_WIDTH * keypoint.sigma;
    let half = PLACES as f32 / 2.0;
    // A corner of the rotated square, plus the half cell that interpolation reaches.
    let radius = place * (half + 0.5) * std::f32::consts::SQRT_2;
    // One bin of padding at each border, and directions that wrap.
    const PADDED: usize = PLACES + 2;
    let mut sums = [[[0.0f32; DIRECTIONS]; PADDED]; PADDED];
    for (dx, dy, x, y) in around(layer, keypoint, radius) {
        let u = (cos * dx + sin * dy) / place;
        let v = (cos * dy - sin * dx) / place;
        let (column, row) = (u + half + 0.5, v + half + 0.5);
        if !(column > 0.0 && row > 0.0 && column < (PADDED - 1) as f32 && row < (PADDED - 1) as f32) {
            continue;
        }
        let (length, direction) = gradient(layer, x, y);
        let weight = length * (-(u * u + v * v) / (2.0 * half * half)).exp();
        let bin = (direction - angle).rem_euclid(TAU) / TAU * DIRECTIONS as f32;
        let (c, r, b) = (column as usize, row as usize, bin as usize);
        let (fc, fr, fb) = (column - c as f32, row - r as f32, bin - b as f32);
        for (row, of_row) in [(r, 1.0 - fr), (r + 1, fr)] {
            for (column, of_column) in [(c, 1.0 - fc), (c + 1, fc)] {
                let share = weight * of_row * of_column;
                let bins = &mut sums[row][column];
                bins[b % DIRECTIONS] += share * (1.0 - fb);
                bins[(b + 1) % DIRECTIONS] += share * fb;
            }
        }
    }
    let mut out = [0.0; DIM];
    let inner = sums[1..=PLACES].iter().flat_map(|row| row[1..=PLACES].as_flattened());
    out.iter_mut().zip(inner).for_each(|(o, s)| *o = *s);
    normalise(&mut out);
    out
}

/// Clips the largest numbers of a descriptor, and takes the root of their shares.
fn normalise(out: &mut Descriptor) {
    let length = out.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    out.iter_mut().for_each(|v| *v = v.min(MAX_SHARE * length));
    let sum = out.iter().sum::<f32>().max(f32::MIN_POSITIVE);
    out.iter_mut().for_each(|v| *v = (*v / sum).sqrt());
}
