//! Segmentation errors simulated on good masks, to measure how each method degrades with them.
//!
//! A mask is missed, merged with a touching mask, or split; its outline frays; its vector turns, as the vectors of one
//! object vary between views. The probability or extent of each error grows with the level. Every mask has its own random
//! sequence, seeded by seed, view and index, so results do not depend on threads or the order of views.

use slag_encoder::encode::Perturbation;
use slag_encoder::masks::{BoxPx, Mask, NO_REGION, masks_of_labels};
use slag_math::random::Xorshift;

/// Probabilities per level. SAM's automatic masks of indoor photos lie between levels 1 and 2: they miss or break about
/// one object in five (our estimate).
const MISSED: f64 = 0.05;
const MERGED: f64 = 0.08;
const SPLIT: f64 = 0.12;
/// Extent of fraying per level, relative to the square root of the mask's area.
const FRAYED: f64 = 0.03;
/// Length of a fray, pixels.
const FRAY_PX: f64 = 8.0;
/// Angle by which a vector turns per level. CLIP's vectors of one object from two views are about 0.4 apart.
const TURN_RAD: f64 = 0.2;
/// Largest gap between the boxes of touching masks.
const TOUCHING_PX: u32 = 3;

/// Level and seed of the simulated errors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MaskNoise {
    /// From 0, no errors, to 3, most masks damaged.
    pub level: u8,
    /// Seed of the errors.
    pub seed: u64,
}

impl Perturbation for MaskNoise {
    fn identity(&self) -> String {
        format!("{self:?}")
    }

    fn masks(&self, view: &str, masks: Vec<Mask>, size_px: [u32; 2]) -> Vec<Mask> {
        self.damaged(view, masks, size_px)
    }

    fn vectors(&self, view: &str, vectors: &mut [f32], dim: usize) {
        self.turn_vectors(view, vectors, dim);
    }
}

impl MaskNoise {
    fn random(&self, view: &str, what: &str, index: usize) -> Xorshift {
        let hash = blake3::hash(format!("{}/{view}/{what}/{index}", self.seed).as_bytes());
        let bytes = hash.as_bytes().first_chunk().copied().unwrap_or_default();
        Xorshift::new(u64::from_le_bytes(bytes))
    }

    /// Returns the damaged masks of a view of `size_px`; at level 0 the masks are unchanged.
    pub fn damaged(&self, view: &str, masks: Vec<Mask>, size_px: [u32; 2]) -> Vec<Mask> {
        if self.level == 0 {
            return masks;
        }
        let level = f64::from(self.level);
        let mut randoms: Vec<Xorshift> = (0..masks.len()).map(|i| self.random(view, "mask", i)).collect();
        let mut left: Vec<Option<Mask>> = masks
            .into_iter()
            .zip(&mut randoms)
            .map(|(mask, random)| (random.unit() >= MISSED * level).then_some(mask))
            .collect();
        let mut found = Vec::new();
        for i in 0..left.len() {
            let Some(mut mask) = left[i].take() else { continue };
            let random = &mut randoms[i];
            if random.unit() < MERGED * level {
                let touching = |other: &Option<Mask>| other.as_ref().is_some_and(|other| touch(&mask, other));
                let partners: Vec<usize> = (i + 1..left.len()).filter(|j| touching(&left[*j])).collect();
                let partner = if partners.is_empty() { None } else { left[*random.pick(&partners)].take() };
                if let Some(other) = partner {
                    mask = union(&mask, &other);
                }
            }
            let pieces = if random.unit() < SPLIT * level { split(&mask, random) } else { vec![mask] };
            found.extend(pieces.iter().filter_map(|piece| frayed(piece, FRAYED * level, size_px, random)));
        }
        found
    }

    /// Turns each of a view's unit vectors `[n][dim]` by the level's angle, in a random direction.
    pub fn turn_vectors(&self, view: &str, vectors: &mut [f32], dim: usize) {
        if self.level == 0 {
            return;
        }
        let (sine, cosine) = (TURN_RAD * f64::from(self.level)).sin_cos();
        for (i, vector) in vectors.chunks_exact_mut(dim).enumerate() {
            let mut random = self.random(view, "vector", i);
            // A sum of four uniform values is nearly normal, so no axis is preferred.
            let normal = |_| (0..4).map(|_| random.signed()).sum::<f64>();
            let mut across: Vec<f64> = (0..dim).map(normal).collect();
            let along: f64 = across.iter().zip(&*vector).map(|(a, v)| a * f64::from(*v)).sum();
            across.iter_mut().zip(&*vector).for_each(|(a, v)| *a -= along * f64::from(*v));
            let length = across.iter().map(|a| a * a).sum::<f64>().sqrt();
            if length > 0.0 {
                let turned =
                    |(v, a): (&mut f32, &f64)| *v = (f64::from(*v) * cosine + a / length * sine) as f32;
                vector.iter_mut().zip(&across).for_each(turned);
            }
        }
    }
}

fn touch(a: &Mask, b: &Mask) -> bool {
    let apart = |a0: u32, a1: u32, b0: u32, b1: u32| a0 > b1 + TOUCHING_PX || b0 > a1 + TOUCHING_PX;
    let (a, b) = (&a.box_px, &b.box_px);
    !apart(a.x0, a.x1, b.x0, b.x1) && !apart(a.y0, a.y1, b.y0, b.y1)
}

/// Returns the mask of the pixels in a box that satisfy `inside`; `None` without any.
fn mask_where(within: BoxPx, level: u8, inside: impl Fn(u32, u32) -> bool) -> Option<Mask> {
    let label = |x: u32, y: u32| if inside(x, y) { 0 } else { NO_REGION };
    let labels: Vec<u32> = (within.y0..within.y1)
        .flat_map(|y| (within.x0..within.x1).map(move |x| (x, y)))
        .map(|(x, y)| label(x, y))
        .collect();
    let (_, mask) = masks_of_labels(&labels, within.width_px(), 1, u64::MAX)?.pop()?;
    let BoxPx { x0, y0, x1, y1 } = mask.box_px;
    let box_px = BoxPx { x0: within.x0 + x0, y0: within.y0 + y0, x1: within.x0 + x1, y1: within.y0 + y1 };
    Some(Mask { box_px, level, ..mask })
}

fn union(a: &Mask, b: &Mask) -> Mask {
    let (box_a, box_b) = (a.box_px, b.box_px);
    let within = BoxPx {
        x0: box_a.x0.min(box_b.x0),
        y0: box_a.y0.min(box_b.y0),
        x1: box_a.x1.max(box_b.x1),
        y1: box_a.y1.max(box_b.y1),
    };
    mask_where(within, a.level, |x, y| a.contains(x, y) || b.contains(x, y)).unwrap_or_else(|| a.clone())
}

/// Cuts a mask along a line near its box's middle and returns the pieces with pixels.
fn split(mask: &Mask, random: &mut Xorshift) -> Vec<Mask> {
    let (sine, cosine) = random.between(0.0, std::f64::consts::PI).sin_cos();
    let BoxPx { x0, y0, .. } = mask.box_px;
    let (width, height) = (f64::from(mask.box_px.width_px()), f64::from(mask.box_px.height_px()));
    let offset = 0.25 * random.signed();
    let beyond = |x: u32, y: u32| {
        let (u, v) = (f64::from(x - x0) / width - 0.5, f64::from(y - y0) / height - 0.5);
        u * cosine + v * sine > offset
    };
    let piece =
        |side: bool| mask_where(mask.box_px, mask.level, |x, y| mask.contains(x, y) && beyond(x, y) == side);
    [true, false].into_iter().filter_map(piece).collect()
}

/// Moves a mask's outline in and out by up to `extent` times the square root of its area.
fn frayed(mask: &Mask, extent: f64, size_px: [u32; 2], random: &mut Xorshift) -> Option<Mask> {
    let extent_px = extent * f64::from(mask.area_px).sqrt();
    let margin_px = extent_px.ceil() as u32;
    let BoxPx { x0, y0, x1, y1 } = mask.box_px;
    let within = BoxPx {
        x0: x0.saturating_sub(margin_px),
        y0: y0.saturating_sub(margin_px),
        x1: (x1 + margin_px).min(size_px[0]),
        y1: (y1 + margin_px).min(size_px[1]),
    };
    // Each pixel is read from a place shifted by a bilinear interpolation of a coarse random grid.
    let columns = (f64::from(within.width_px()) / FRAY_PX) as usize + 2;
    let rows = (f64::from(within.height_px()) / FRAY_PX) as usize + 2;
    let grid: Vec<[f64; 2]> =
        (0..columns * rows).map(|_| [0, 1].map(|_| extent_px * random.signed())).collect();
    let shift = |x: u32, y: u32| -> [f64; 2] {
        let (u, v) = (f64::from(x - within.x0) / FRAY_PX, f64::from(y - within.y0) / FRAY_PX);
        let (column, row) = (u as usize, v as usize);
        let (s, t) = (u.fract(), v.fract());
        let at = |dx: usize, dy: usize| grid[(row + dy) * columns + column + dx];
        [0, 1].map(|c| {
            let top = at(0, 0)[c] * (1.0 - s) + at(1, 0)[c] * s;
            let bottom = at(0, 1)[c] * (1.0 - s) + at(1, 1)[c] * s;
            top * (1.0 - t) + bottom * t
        })
    };
    mask_where(within, mask.level, |x, y| {
        let [dx, dy] = shift(x, y);
        let (from_x, from_y) = (f64::from(x) + dx, f64::from(y) + dy);
        from_x >= 0.0 && from_y >= 0.0 && mask.contains(from_x.round() as u32, from_y.round() as u32)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn disc(cx: f64, cy: f64, radius: f64) -> Mask {
        let within = BoxPx { x0: 0, y0: 0, x1: 200, y1: 150 };
        let inside = |x: u32, y: u32| (f64::from(x) - cx).hypot(f64::from(y) - cy) < radius;
        mask_where(within, 0, inside).expect("pixels")
    }

    fn discs() -> Vec<Mask> {
        (0..60).map(|i| disc(20.0 + f64::from(i % 10) * 18.0, 15.0 + f64::from(i / 10) * 22.0, 8.0)).collect()
    }

    fn iou(a: &Mask, b: &Mask) -> f64 {
        let (mut both, mut either) = (0, 0);
        for y in 0..150 {
            for x in 0..200 {
                both += u32::from(a.contains(x, y) && b.contains(x, y));
                either += u32::from(a.contains(x, y) || b.contains(x, y));
            }
        }
        f64::from(both) / f64::from(either)
    }

    #[test]
    fn level_0_changes_nothing_and_equal_seeds_and_views_give_equal_damage() {
        let noise = |level, seed| MaskNoise { level, seed };
        let damaged = |noise: MaskNoise, view| noise.damaged(view, discs(), [200, 150]);
        assert_eq!(damaged(noise(0, 1), "a"), discs());
        assert_eq!(damaged(noise(2, 1), "a"), damaged(noise(2, 1), "a"));
        assert_ne!(damaged(noise(2, 1), "a"), damaged(noise(2, 2), "a"));
        assert_ne!(damaged(noise(2, 1), "a"), damaged(noise(2, 1), "b"));
    }

    /// Masks match their boxes and areas, and deviate more from the true masks with each level.
    #[test]
    fn masks_are_consistent_and_get_worse_with_the_level() {
        let mean_iou = |level: u8| {
            let found = MaskNoise { level, seed: 5 }.damaged("view", discs(), [200, 150]);
            for mask in &found {
                let n = mask.inside.iter().filter(|inside| **inside).count();
                assert_eq!(n, mask.area_px as usize);
                assert_eq!(mask.inside.len(), (mask.box_px.width_px() * mask.box_px.height_px()) as usize);
                assert!(mask.box_px.x1 <= 200 && mask.box_px.y1 <= 150 && n > 0);
            }
            let best = |disc: &Mask| found.iter().map(|mask| iou(disc, mask)).fold(0.0, f64::max);
            discs().iter().map(best).sum::<f64>() / 60.0
        };
        let ious = [0, 1, 2, 3].map(mean_iou);
        println!("{ious:?}");
        assert!(ious[0] == 1.0 && ious.is_sorted_by(|a, b| *a > *b + 0.03) && ious[3] > 0.3, "{ious:?}");
    }

    /// Oracle: the angle in float64.
    #[test]
    fn vectors_turn_by_the_stated_angle_and_stay_unit() {
        let noise = MaskNoise { level: 2, seed: 9 };
        let mut vectors = vec![0.0f32; 3 * 64];
        (0..3).for_each(|i| vectors[i * 64 + i] = 1.0);
        noise.turn_vectors("view", &mut vectors, 64);
        for (i, vector) in vectors.chunks(64).enumerate() {
            let length: f64 = vector.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            assert!((length - 1.0).abs() < 1e-6);
            assert!((f64::from(vector[i]).acos() - 0.4).abs() < 1e-6);
        }
    }
}
