//! The map that photos are matched with.

use std::collections::BTreeMap;

use glam::DVec3;
use slag_common::landmarks::Landmark;

use crate::describe::{DIM, Descriptor};

/// Landmarks within this share of the map's size are one place: such a second-best match is no rival.
const SAME_PLACE: f64 = 0.01;

/// The landmarks of a scene, or of its part on board.
#[derive(Clone, Debug)]
pub struct Map {
    pub(crate) landmarks: Vec<Landmark>,
    /// Per view: indices of landmarks.
    pub(crate) of_views: BTreeMap<u16, Vec<u32>>,
    /// Per view: the median of its landmarks' positions.
    middles: BTreeMap<u16, DVec3>,
    /// Squared distance up to which two landmarks are one place.
    pub(crate) same_place: f64,
}

impl Map {
    pub fn new(landmarks: Vec<Landmark>) -> Self {
        let mut of_views: BTreeMap<u16, Vec<u32>> = BTreeMap::new();
        for (index, landmark) in (0..).zip(&landmarks) {
            of_views.entry(landmark.view).or_default().push(index);
        }
        let positions = |of: &[u32]| of.iter().map(|at| landmarks[*at as usize].position_in_world).collect();
        let middles = of_views.iter().map(|(view, of)| (*view, middle(positions(of)))).collect();
        // Medians, so that a few landmarks far away do not enlarge the scene.
        let of_all = middle(landmarks.iter().map(|l| l.position_in_world).collect());
        let size = median(landmarks.iter().map(|l| l.position_in_world.distance(of_all)).collect());
        Self { of_views, middles, same_place: (SAME_PLACE * size).powi(2), landmarks }
    }

    /// Returns the landmarks of the `n` views nearest to a view by place, itself included.
    pub(crate) fn around(&self, view: u16, n: usize) -> Vec<u32> {
        let middle = self.middles[&view];
        let mut views: Vec<(u16, f64)> =
            self.middles.iter().map(|(other, at)| (*other, at.distance_squared(middle))).collect();
        views.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        views.iter().take(n).flat_map(|(view, _)| self.of_views[view].iter().copied()).collect()
    }

    pub fn len(&self) -> usize {
        self.landmarks.len()
    }

    pub fn is_empty(&self) -> bool {
        self.landmarks.is_empty()
    }
}

/// Bytes of a map of `n` landmarks: themselves, the views' lists, and one more list for a median.
pub fn map_bytes(n: usize) -> usize {
    n * (size_of::<Landmark>() + 2 * size_of::<u32>() + 2 * size_of::<DVec3>())
}

pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

pub(crate) fn middle(points: Vec<DVec3>) -> DVec3 {
    DVec3::from([0, 1, 2].map(|axis| median(points.iter().map(|point| point[axis]).collect())))
}

pub type Code = u128;

/// Version of the codes: other versions cannot be matched.
pub const CODE_VERSION: u32 = 1;

/// `[DIM]` the mean of descriptors, u8 in 1/1000, then `[128][DIM]` the directions, i8, of any length. Learned from
/// the features of two scenes (`train_codes.py`).
static LEARNED: &[u8; DIM + 128 * DIM] = include_bytes!("codes-1.bin");
const MEAN_STEP: f32 = 1e-3;

pub fn code(descriptor: &Descriptor) -> Code {
    let (mean, directions) = LEARNED.split_at(DIM);
    let mut centred = *descriptor;
    centred.iter_mut().zip(mean).for_each(|(v, m)| *v -= f32::from(*m) * MEAN_STEP);
    let bit = |direction: &[u8]| {
        let mut along = [0.0; DIM];
        along.iter_mut().zip(direction).for_each(|(a, d)| *a = f32::from(*d as i8));
        u128::from(slag_math::dot(&along, &centred) > 0.0)
    };
    directions.chunks_exact(DIM).enumerate().map(|(at, direction)| bit(direction) << at).sum()
}

/// Number of bits in which two codes differ.
pub fn distance(a: Code, b: Code) -> u32 {
    (a ^ b).count_ones()
}
