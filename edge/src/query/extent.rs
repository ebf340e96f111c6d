//! Where points are, without their floaters.

use glam::DVec3;
use slag_common::frames::Aabb;
use slag_math::stats::trimmed_range;

/// Share of points that a box leaves out at either end of each axis, so that a few floaters do not inflate it.
pub const TRIMMED: f64 = 0.02;

/// Box and centre of points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    /// Mean of the points inside the box.
    pub position_in_world: DVec3,
    /// From the 2nd to the 98th percentile along each axis (all points if they are fewer than 51).
    pub box_in_world: Aabb,
}

impl Extent {
    /// Measures points; at least one.
    pub fn of(points: &[DVec3]) -> Self {
        let box_in_world = trimmed_box(points);
        let inside = points.iter().filter(|point| box_in_world.contains(**point));
        let (sum, n) = inside.fold((DVec3::ZERO, 0u64), |(sum, n), point| (sum + *point, n + 1));
        // Trimming leaves out at most 4 % per axis, so some point is inside along all three.
        Self { position_in_world: sum / n as f64, box_in_world }
    }
}

fn trimmed_box(points: &[DVec3]) -> Aabb {
    let (mut min, mut max) = (DVec3::ZERO, DVec3::ZERO);
    let mut values = Vec::with_capacity(points.len());
    for axis in 0..3 {
        values.clear();
        values.extend(points.iter().map(|point| point[axis]));
        (min[axis], max[axis]) = trimmed_range(&mut values, TRIMMED).unwrap_or_default();
    }
    Aabb { min, max }
}
