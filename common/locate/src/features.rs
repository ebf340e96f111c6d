//! SIFT features (Lowe 2004): extrema of differences of Gaussians, subpixel in position and scale, each with an
//! orientation and a descriptor of the gradients around it.

use crate::describe::{Descriptor, Keypoint, describe, orientations};
use crate::grey::Grey;

pub const MAX_FEATURES: usize = 1200;
/// Scales per octave (Lowe 2004, 3.1).
const SCALES: usize = 3;
/// Blur of an octave's first scale, its pixels (Lowe 2004, 3.3).
const SIGMA: f32 = 1.6;
/// Assumed blur of a photo, pixels.
const CAMERA_SIGMA: f32 = 0.5;
/// Least contrast of a keypoint, of 0..=1. Lowe has 0.03; on plain walls most keypoints that two photos share are
/// weaker, and elsewhere the strongest are kept.
const MIN_CONTRAST: f32 = 0.0067;
/// Largest ratio of principal curvatures; above it is an edge (Lowe 2004, 4.1).
const MAX_CURVATURE_RATIO: f32 = 10.0;
/// Width of the border of each octave without keypoints, pixels.
const BORDER: usize = 5;
const MAX_STEPS: usize = 5;
/// Larger photos are halved: see [`working_bytes`].
pub(crate) const MAX_PX: usize = 1_500_000;
/// Shortest side of an octave, pixels.
const MIN_SIDE: usize = 16;

#[derive(Clone, Debug, PartialEq)]
pub struct Feature {
    /// Pixels; the centre of the first pixel is 0.5.
    pub at: [f64; 2],
    /// Blur at which it was found, pixels of the photo.
    pub sigma: f32,
    /// Direction of the gradients around it, radians.
    pub angle: f32,
    /// Of 0..=1.
    pub contrast: f32,
    pub descriptor: Descriptor,
}

struct Octave {
    layers: Vec<Grey>,
    /// Width of its pixels, in pixels of the photo.
    pixel: f32,
}

/// Returns the strongest `limit` features of a photo, strongest first; ties by position.
pub fn features(photo: &Grey, limit: usize) -> Vec<Feature> {
    let (photo, factor) = photo.limited(MAX_PX);
    if photo.width < MIN_SIDE || photo.height < MIN_SIDE {
        return Vec::new();
    }
    // Doubled, so that the finest details become keypoints; this doubles the blur.
    let first = (SIGMA * SIGMA - 4.0 * CAMERA_SIGMA * CAMERA_SIGMA).sqrt();
    let mut base = photo.doubled().blurred(first);
    let mut pixel = 0.5 * factor as f32;
    let mut octaves: Vec<Octave> = Vec::new();
    let mut found: Vec<(usize, Keypoint)> = Vec::new();
    while base.width >= MIN_SIDE && base.height >= MIN_SIDE {
        let layers = blurred_layers(base);
        let mut keypoints = extrema(&layers);
        // No octave keeps more than the total limit: bounds the memory on noise.
        keypoints.sort_by(stronger);
        keypoints.truncate(limit);
        found.extend(keypoints.into_iter().map(|keypoint| (octaves.len(), keypoint)));
        base = layers[SCALES].halved();
        octaves.push(Octave { layers, pixel });
        pixel *= 2.0;
    }
    found.sort_by(|(p, a), (q, b)| stronger(a, b).then(p.cmp(q)));
    let of_keypoint = |(octave, keypoint): (usize, Keypoint)| {
        let Octave { layers, pixel } = &octaves[octave];
        let layer = &layers[keypoint.layer];
        orientations(layer, &keypoint).into_iter().map(move |angle| Feature {
            // Pixel 0 of the doubled image is the centre of the photo's first pixel.
            at: [keypoint.x, keypoint.y].map(|c| f64::from(c * pixel) + 0.5 * f64::from(factor)),
            sigma: keypoint.sigma * pixel,
            angle,
            contrast: keypoint.contrast,
            descriptor: describe(layer, &keypoint, angle),
        })
    };
    found.into_iter().flat_map(of_keypoint).take(limit).collect()
}

/// Most bytes for finding the features of a photo, besides the photo.
pub fn working_bytes(width: usize, height: usize) -> usize {
    let mut n_px = width * height;
    while n_px > MAX_PX {
        n_px /= 4;
    }
    // The halved photo; and, of the doubled photo, each layer over all octaves, and an image between two passes.
    let n_layers = SCALES + 3;
    n_px.max(width * height / 4) * size_of::<f32>() + 4 * n_px * size_of::<f32>() * (n_layers * 4 / 3 + 2)
}

fn stronger(a: &Keypoint, b: &Keypoint) -> std::cmp::Ordering {
    b.contrast.total_cmp(&a.contrast).then(a.y.total_cmp(&b.y)).then(a.x.total_cmp(&b.x))
}

/// Images of an octave: blur [`SIGMA`] times `2^(i / SCALES)`.
fn blurred_layers(base: Grey) -> Vec<Grey> {
    let step = 2f32.powf(1.0 / SCALES as f32);
    let mut layers = vec![base];
    for i in 1..SCALES + 3 {
        let before = SIGMA * step.powi(i as i32 - 1);
        let more = before * (step * step - 1.0).sqrt();
        let next = layers[i - 1].blurred(more);
        layers.push(next);
    }
    layers
}

struct Differences<'a> {
    layers: &'a [Grey],
    width: usize,
}

impl Differences<'_> {
    fn at(&self, layer: usize, pixel: usize) -> f32 {
        self.layers[layer + 1].values[pixel] - self.layers[layer].values[pixel]
    }

    /// Whether no neighbour in space and scale is farther from 0.
    fn is_extremum(&self, layer: usize, pixel: usize, value: f32) -> bool {
        let sign = value.signum();
        let rows = [pixel - self.width, pixel, pixel + self.width];
        [layer, layer - 1, layer + 1].into_iter().all(|layer| {
            let mut neighbours = rows.into_iter().flat_map(|row| row - 1..=row + 1);
            neighbours.all(|at| self.at(layer, at) * sign <= value * sign)
        })
    }

    /// Gradient and Hessian along x, y and scale.
    fn derivatives(&self, layer: usize, pixel: usize) -> ([f32; 3], [[f32; 3]; 3]) {
        let w = self.width;
        let d = |layer: usize, pixel: usize| self.at(layer, pixel);
        let centre = d(layer, pixel);
        let pairs = [
            (d(layer, pixel - 1), d(layer, pixel + 1)),
            (d(layer, pixel - w), d(layer, pixel + w)),
            (d(layer - 1, pixel), d(layer + 1, pixel)),
        ];
        let gradient = pairs.map(|(before, after)| 0.5 * (after - before));
        let [xx, yy, ss] = pairs.map(|(before, after)| before + after - 2.0 * centre);
        let xy = 0.25
            * (d(layer, pixel + w + 1) - d(layer, pixel + w - 1) - d(layer, pixel - w + 1)
                + d(layer, pixel - w - 1));
        let mixed = |step: usize| {
            0.25 * (d(layer + 1, pixel + step) - d(layer + 1, pixel - step) - d(layer - 1, pixel + step)
                + d(layer - 1, pixel - step))
        };
        let (xs, ys) = (mixed(1), mixed(w));
        (gradient, [[xx, xy, xs], [xy, yy, ys], [xs, ys, ss]])
    }
}

fn extrema(layers: &[Grey]) -> Vec<Keypoint> {
    let (width, height) = (layers[0].width, layers[0].height);
    let differences = Differences { layers, width };
    // Contrast before interpolation may be lower (as in OpenCV).
    let least = 0.5 * MIN_CONTRAST;
    let mut found = Vec::new();
    for layer in 1..=SCALES {
        for y in BORDER..height.saturating_sub(BORDER) {
            for x in BORDER..width.saturating_sub(BORDER) {
                let pixel = y * width + x;
                let value = differences.at(layer, pixel);
                if value.abs() > least && differences.is_extremum(layer, pixel, value) {
                    found.extend(interpolate(&differences, layer, x, y, height));
                }
            }
        }
    }
    found
}

/// Returns the extremum near a pixel (Lowe 2004, 4) unless it lacks contrast or is an edge.
fn interpolate(
    differences: &Differences<'_>,
    mut layer: usize,
    mut x: usize,
    mut y: usize,
    height: usize,
) -> Option<Keypoint> {
    let width = differences.width;
    for _ in 0..MAX_STEPS {
        let pixel = y * width + x;
        let (gradient, hessian) = differences.derivatives(layer, pixel);
        let offset = glam::Mat3::from_cols_array_2d(&hessian);
        let g = glam::Vec3::from(gradient);
        let offset = -(offset.inverse() * g);
        if !offset.is_finite() {
            return None;
        }
        if offset.abs().max_element() < 0.5 {
            let contrast = (differences.at(layer, pixel) + 0.5 * g.dot(offset)).abs();
            let [[xx, xy, _], [_, yy, _], _] = hessian;
            let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
            let r = MAX_CURVATURE_RATIO;
            let is_edge = determinant <= 0.0 || trace * trace * r >= (r + 1.0) * (r + 1.0) * determinant;
            let scale = layer as f32 + offset.z;
            return (contrast >= MIN_CONTRAST && !is_edge).then(|| Keypoint {
                x: x as f32 + offset.x,
                y: y as f32 + offset.y,
                layer,
                sigma: SIGMA * 2f32.powf(scale / SCALES as f32),
                contrast,
            });
        }
        let moved = |at: usize, by: f32| (at as f32 + by.round()).max(0.0) as usize;
        (x, y, layer) = (moved(x, offset.x), moved(y, offset.y), moved(layer, offset.z));
        let inside = |at: usize, n: usize| (BORDER..n.saturating_sub(BORDER)).contains(&at);
        if !(1..=SCALES).contains(&layer) || !inside(x, width) || !inside(y, height) {
            return None;
        }
    }
    None
}
