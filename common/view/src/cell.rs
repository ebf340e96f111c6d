//! `GET /v1/view/cells/{id}`: a cell's Gaussians, 16 bytes each; all, or every n-th (first picture, far cells).

use glam::{DVec3, Vec3};
use half::f16;
use slag_common::appearance::{Appearance, larger_size_code, size_code};

const MAGIC: [u8; 4] = *b"SLGG";
const VERSION: u32 = 1;
pub const CELL_HEAD_BYTES: usize = 32;
pub const GAUSSIAN_BYTES: usize = 16;
/// Colour and opacity of Gaussians without appearance; the page shades them by height.
const PLAIN: [u8; 4] = [160, 160, 160, 230];
/// No rotation, see [`slag_common::appearance::rotation_code`].
const UNTURNED: [u8; 3] = [255, 128, 0];

/// Writes a cell's message: magic, version, N (u32), the origin in the world (three f32), flags (u32; 1: has
/// appearance), `step` (u32); then a column each of centres minus the origin (three f16), colours, opacities, sizes
/// and rotations.
///
/// `positions`: `[N]`, world, of every `step`-th Gaussian of the cell, from the first; `appearance`: of all its
/// Gaussians. Each one sent has the area of `step` of them. Without an appearance, sizes are distances to neighbours
/// in the shard's order, which follows a space-filling curve.
pub fn cell_message(positions: &[DVec3], appearance: Option<Appearance<'_>>, step: Step) -> Vec<u8> {
    let low = positions.iter().copied().reduce(DVec3::min).unwrap_or_default();
    let high = positions.iter().copied().reduce(DVec3::max).unwrap_or_default();
    // As the page reads it: the origin's rounding error goes to the centres.
    let origin: Vec3 = ((low + high) / 2.0).as_vec3();
    let n = positions.len();
    let mut message = Vec::with_capacity(CELL_HEAD_BYTES + GAUSSIAN_BYTES * n);
    message.extend(MAGIC);
    message.extend(VERSION.to_le_bytes());
    message.extend((n as u32).to_le_bytes());
    origin.to_array().iter().for_each(|axis| message.extend(axis.to_le_bytes()));
    message.extend(u32::from(appearance.is_some()).to_le_bytes());
    message.extend((step.0 as u32).to_le_bytes());
    for position in positions {
        let offset = *position - origin.as_dvec3();
        offset.to_array().iter().for_each(|axis| message.extend(f16::from_f64(*axis).to_le_bytes()));
    }
    match appearance {
        Some(Appearance { colours, sizes, rotations }) => {
            let times = (step.0 as f32).sqrt();
            message.extend(step.of(colours).flat_map(|[r, g, b, _]| [*r, *g, *b]));
            message.extend(step.of(colours).map(|[.., opacity]| *opacity));
            message.extend(step.of(sizes).flatten().map(|code| larger_size_code(*code, times)));
            message.extend(step.of(rotations).flatten());
        }
        None => {
            let [r, g, b, opacity] = PLAIN;
            message.extend(std::iter::repeat_n([r, g, b], n).flatten());
            message.extend(std::iter::repeat_n(opacity, n));
            message.extend(sizes(positions).into_iter().flat_map(|size| [size_code(size); 3]));
            message.extend(std::iter::repeat_n(UNTURNED, n).flatten());
        }
    }
    message
}

/// Every n-th Gaussian of a cell is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Step(usize);

impl Step {
    pub const ALL: Self = Self(1);
    pub const MAX: usize = 1 << 16;

    pub fn parse(text: &str) -> Result<Self, &'static str> {
        let step = text.parse().ok().filter(|step| (1..=Self::MAX).contains(step));
        step.map(Self).ok_or("a whole number from 1 to 65536")
    }

    pub fn of<T>(self, all: &[T]) -> impl Iterator<Item = &T> {
        all.iter().step_by(self.0)
    }

    pub fn indices(self, n: usize) -> impl ExactSizeIterator<Item = usize> {
        (0..n).step_by(self.0)
    }
}

/// Returns half the distance to the nearer neighbour in order, clamped to a quarter and twice the median.
fn sizes(positions: &[DVec3]) -> Vec<f32> {
    let apart: Vec<f32> = positions.windows(2).map(|pair| pair[0].distance(pair[1]) as f32).collect();
    let mut sorted: Vec<f32> = apart.iter().copied().filter(|d| *d > 0.0).collect();
    let middle = sorted.len() / 2;
    let median = match sorted.is_empty() {
        true => 0.02,
        false => *sorted.select_nth_unstable_by(middle, f32::total_cmp).1 / 2.0,
    };
    let distance = |at: Option<usize>| at.and_then(|at| apart.get(at)).copied().unwrap_or(f32::INFINITY);
    (0..positions.len())
        .map(|at| distance(at.checked_sub(1)).min(distance(Some(at))) / 2.0)
        .map(|half| half.clamp(median / 4.0, median * 2.0))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn f16_at(message: &[u8], at: usize) -> f64 {
        f16::from_le_bytes([message[at], message[at + 1]]).to_f64()
    }

    #[test]
    fn messages_have_the_layout_of_the_documents() {
        let positions = [DVec3::new(1e5, 2.0, 3.0), DVec3::new(1e5 + 1.0, 2.5, 3.0)];
        let appearance = Appearance {
            colours: &[[1, 2, 3, 4], [5, 6, 7, 8]],
            sizes: &[[9, 10, 11], [12, 13, 14]],
            rotations: &[[15, 16, 17], [18, 19, 20]],
        };
        let message = cell_message(&positions, Some(appearance), Step::ALL);
        assert_eq!((&message[..4], message[8], message[24], message[28]), (b"SLGG".as_slice(), 2, 1, 1));
        let origin = f32::from_le_bytes(message[12..16].try_into().expect("4 bytes"));
        for (at, position) in positions.iter().enumerate() {
            assert!((f64::from(origin) + f16_at(&message, 32 + 6 * at) - position.x).abs() < 1e-3);
        }
        let expected = [1, 2, 3, 5, 6, 7, 4, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20];
        assert_eq!(message[44..], expected);
        assert_eq!(cell_message(&[], None, Step::ALL).len(), CELL_HEAD_BYTES);
    }

    /// Of nine surfels two are sent, each 2.83 times as wide: 1 + 254 * (ln s + 12) / 21 grows by 12.6.
    #[test]
    fn few_gaussians_cover_what_all_did() {
        let all: Vec<DVec3> = (0..9).map(|i| DVec3::new(f64::from(i), 0.0, 0.0)).collect();
        let sizes: Vec<[u8; 3]> = (0..9).map(|i| [100 + i, 0, 250]).collect();
        let colours: Vec<[u8; 4]> = (0..9).map(|i| [i, 0, 0, 10 + i]).collect();
        let rotations: Vec<[u8; 3]> = (0..9).map(|i| [20 + i, 0, 0]).collect();
        let appearance = Appearance { colours: &colours, sizes: &sizes, rotations: &rotations };
        let step = Step::parse("8").expect("a step");
        let positions: Vec<DVec3> = step.indices(9).map(|at| all[at]).collect();
        let message = cell_message(&positions, Some(appearance), step);
        assert_eq!((message[8], message[28], message.len()), (2, 8, CELL_HEAD_BYTES + 2 * GAUSSIAN_BYTES));
        assert_eq!(message[44..], [0, 0, 0, 8, 0, 0, 10, 18, 113, 0, 255, 121, 0, 255, 20, 0, 0, 28, 0, 0]);
        for wrong in ["0", "65537", "-1", "x", ""] {
            assert!(Step::parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn unknown_sizes_follow_the_distances() {
        let line: Vec<DVec3> = [0.0, 0.1, 0.2, 0.3, 9.0].map(|x| DVec3::new(x, 0.0, 0.0)).to_vec();
        let found = sizes(&line);
        assert!(found[..4].iter().all(|size| (size - 0.05).abs() < 1e-6), "{found:?}");
        assert!((found[4] - 0.1).abs() < 1e-6, "a stray one is no balloon: {found:?}");
        assert_eq!(sizes(&[DVec3::ZERO]), [0.04]);
    }
}
