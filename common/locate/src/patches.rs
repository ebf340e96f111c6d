//! Searches patches of a photo in a rendering by normalised cross-correlation, for splats too blurred for features.

use std::collections::BTreeSet;

use glam::DVec2;

use crate::features::Feature;
use crate::grey::Grey;

/// A patch's pixels on each side of its centre.
const RADIUS: usize = 7;
const SIDE: usize = 2 * RADIUS + 1;
const N_PX: f32 = (SIDE * SIDE) as f32;
/// Search radius, pixels.
const SEARCH_PX: usize = 12;
const N_STEPS: usize = 2 * SEARCH_PX + 1;
/// Features within a square of so many pixels share one patch.
const SQUARE_PX: f64 = 4.0;
/// Least standard deviation of a patch: below it, there is nothing to recognise.
const MIN_DEVIATION: f32 = 0.01;
/// The same for the rendering, which is smoother.
const MIN_RENDERED_DEVIATION: f32 = 0.005;
const MIN_CORRELATION: f32 = 0.7;
/// Blur of both images, against noise.
const SIGMA: f32 = 0.8;

pub(crate) struct Found {
    pub(crate) n_tried: usize,
    /// Features, and the positions of their patches in the rendering, its pixels.
    pub(crate) matches: Vec<(usize, DVec2)>,
}

/// Searches the patch around each feature in a rendering of the same scale, near `at`, its predicted position.
/// `px`: width of a pixel of `photo`, in the features' pixels.
pub(crate) fn find(photo: &Grey, px: f64, features: &[Feature], at: &[DVec2], rendering: &Grey) -> Found {
    let (photo, rendering) = (photo.blurred(SIGMA), rendering.blurred(SIGMA));
    let mut squares = BTreeSet::new();
    let mut found = Found { n_tried: 0, matches: Vec::new() };
    for (index, (feature, at)) in features.iter().zip(at).enumerate() {
        let centre = DVec2::from(feature.at) / px;
        let square = (centre / SQUARE_PX).floor();
        if !squares.insert((square.x as i64, square.y as i64)) {
            continue;
        }
        let Some(patch) = Patch::around(&photo, centre) else { continue };
        found.n_tried += 1;
        if let Some(offset) = patch.find(&rendering, *at) {
            found.matches.push((index, at.floor() + (centre - centre.floor()) + offset));
        }
    }
    found
}

/// Part of an image with mean 0 and length 1.
struct Patch([[f32; SIDE]; SIDE]);

/// Returns the first pixel of the part around a pixel, if it lies within the image.
fn corner(of: &Grey, centre: DVec2) -> Option<[usize; 2]> {
    let first = centre.floor() - RADIUS as f64;
    let end = first + SIDE as f64;
    let is_within = first.min_element() >= 0.0 && end.x <= of.width as f64 && end.y <= of.height as f64;
    is_within.then_some([first.x as usize, first.y as usize])
}

impl Patch {
    /// Returns the patch around a position; `None` at the border and for a plain patch.
    fn around(photo: &Grey, centre: DVec2) -> Option<Self> {
        let [x, y] = corner(photo, centre)?;
        let mut rows: [[f32; SIDE]; SIDE] =
            std::array::from_fn(|row| std::array::from_fn(|k| photo.values[(y + row) * photo.width + x + k]));
        let values = rows.as_flattened_mut();
        let mean = values.iter().sum::<f32>() / N_PX;
        values.iter_mut().for_each(|v| *v -= mean);
        let length = values.iter().map(|v| v * v).sum::<f32>().sqrt();
        if length.is_nan() || length < MIN_DEVIATION * N_PX.sqrt() {
            return None;
        }
        values.iter_mut().for_each(|v| *v /= length);
        Some(Self(rows))
    }

    /// Returns the subpixel offset at which the rendering shows the patch.
    fn find(&self, rendering: &Grey, near: DVec2) -> Option<DVec2> {
        let step = |k: usize| k as f64 - SEARCH_PX as f64;
        let score = |x: usize, y: usize| {
            corner(rendering, near + DVec2::new(step(x), step(y)))
                .map_or(-1.0, |at| self.score(rendering, at))
        };
        let scores: [[f32; N_STEPS]; N_STEPS] = std::array::from_fn(|y| std::array::from_fn(|x| score(x, y)));
        let all = scores.iter().enumerate();
        let all = all.flat_map(|(y, row)| row.iter().enumerate().map(move |(x, score)| (*score, x, y)));
        let (most, x, y) = all.max_by(|a, b| a.0.total_cmp(&b.0))?;
        let is_inside = |k: usize| k > 0 && k + 1 < N_STEPS;
        if most < MIN_CORRELATION || !is_inside(x) || !is_inside(y) {
            return None;
        }
        let around =
            [0, 1, 2].map(|row| [0, 1, 2].map(|column| f64::from(scores[y + row - 1][x + column - 1])));
        Some(DVec2::new(step(x), step(y)) + top(around))
    }

    /// Correlation, -1 to 1, with the part of a rendering that starts at a pixel.
    fn score(&self, rendering: &Grey, [x, y]: [usize; 2]) -> f32 {
        let (mut sum, mut squares, mut product) = (0.0, 0.0, 0.0);
        for (row, patch) in self.0.iter().enumerate() {
            let part = &rendering.values[(y + row) * rendering.width + x..][..SIDE];
            for (v, p) in part.iter().zip(patch) {
                sum += v;
                squares += v * v;
                product += v * p;
            }
        }
        let variance = squares - sum * sum / N_PX;
        if variance > N_PX * MIN_RENDERED_DEVIATION.powi(2) { product / variance.sqrt() } else { -1.0 }
    }
}

/// Returns the top of the paraboloid through nine scores, relative to the middle one; at most one pixel.
fn top([[nw, n, ne], [w, middle, e], [sw, s, se]]: [[f64; 3]; 3]) -> DVec2 {
    let slope = 0.5 * DVec2::new(e - w, s - n);
    let (xx, xy, yy) = (w - 2.0 * middle + e, 0.25 * (se - sw - ne + nw), n - 2.0 * middle + s);
    let determinant = xx * yy - xy * xy;
    if xx >= 0.0 || determinant <= 0.0 {
        return DVec2::ZERO;
    }
    let step = DVec2::new(xy * slope.y - yy * slope.x, xy * slope.x - xx * slope.y) / determinant;
    step.clamp(DVec2::NEG_ONE, DVec2::ONE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::describe::DIM;

    fn waves(seed: f64, moved: DVec2) -> Grey {
        let (width, height) = (160, 120);
        let value = |x: f64, y: f64| {
            let wave = |k: f64| {
                let along = DVec2::from_angle(seed + k * 0.4);
                ((x * along.x + y * along.y) * (0.3 + 0.04 * k) + seed * k * k).sin()
            };
            0.5 + 0.05 * (0..8).map(|k| wave(f64::from(k))).sum::<f64>()
        };
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (f64::from(x), f64::from(y))));
        let values = pixels.map(|(x, y)| value(x - moved.x, y - moved.y) as f32).collect();
        Grey { width: width as usize, height: height as usize, values }
    }

    #[test]
    fn patches_are_found_where_a_picture_moved_to() {
        let moved = DVec2::new(3.4, -2.7);
        let places =
            (2..14).flat_map(|x| (2..10).map(move |y| [f64::from(x) * 10.0 + 0.3, f64::from(y) * 10.0]));
        let feature =
            |at: [f64; 2]| Feature { at, sigma: 2.0, angle: 0.0, contrast: 0.1, descriptor: [0.0; DIM] };
        let features: Vec<Feature> = places.map(feature).collect();
        let at: Vec<DVec2> = features.iter().map(|feature| DVec2::from(feature.at)).collect();
        let photo = waves(1.0, DVec2::ZERO);
        let Found { n_tried, matches } = find(&photo, 1.0, &features, &at, &waves(1.0, moved));
        assert_eq!((n_tried, matches.len()), (96, 96));
        for (feature, found) in matches {
            let error = found.distance(at[feature] + moved);
            assert!(error < 0.15, "{found} {error}");
        }
        let other = find(&photo, 1.0, &features, &at, &waves(2.0, moved));
        let right =
            other.matches.iter().filter(|(feature, found)| found.distance(at[*feature] + moved) < 2.0);
        assert!(right.count() < 5);
        // At half the size, and at a border, where patches would reach out.
        let halved = find(
            &photo.halved(),
            2.0,
            &features,
            &at.iter().map(|at| *at / 2.0).collect::<Vec<_>>(),
            &photo.halved(),
        );
        assert!(halved.matches.len() > 60);
        halved.matches.iter().for_each(|(feature, found)| assert!(found.distance(at[*feature] / 2.0) < 0.1));
        let corner = [feature([3.0, 3.0])];
        assert_eq!(find(&photo, 1.0, &corner, &[DVec2::splat(3.0)], &photo).n_tried, 0);
    }
}
