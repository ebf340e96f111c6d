//! The map that photos are matched with.

use std::collections::BTreeMap;

use glam::DVec3;
use slag_common::landmarks::Landmark;

/// Share of the map's size within which two landmarks are one place: such a second-best match is no rival.
const SAME_PLACE: f64 = 0.01;

/// The landmarks of a scene, or of the part that is on board.
#[derive(Clone, Debug)]
pub struct Map {
    pub(crate) landmarks: Vec<Landmark>,
    /// By view: indices of landmarks.
    pub(crate) of_views: BTreeMap<u16, Vec<u32>>,
    /// Squared distance up to which two landmarks are one place.
    pub(crate) same_place: f64,
}

impl Map {
    pub fn new(landmarks: Vec<Landmark>) -> Self {
        let mut of_views: BTreeMap<u16, Vec<u32>> = BTreeMap::new();
        for (index, landmark) in (0..).zip(&landmarks) {
            of_views.entry(landmark.view).or_default().push(index);
        }
        // Medians: a few landmarks far away do not make the scene large.
        let median = |of: &dyn Fn(&Landmark) -> f64| {
            let mut values: Vec<f64> = landmarks.iter().map(of).collect();
            values.sort_by(f64::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or(0.0)
        };
        let middle = DVec3::from([0, 1, 2].map(|axis| median(&|l| l.position_in_world[axis])));
        let size = median(&|l| l.position_in_world.distance(middle));
        Self { of_views, same_place: (SAME_PLACE * size).powi(2), landmarks }
    }

    /// Returns the number of landmarks.
    pub fn len(&self) -> usize {
        self.landmarks.len()
    }

    pub fn is_empty(&self) -> bool {
        self.landmarks.is_empty()
    }
}
