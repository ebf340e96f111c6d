//! Short vectors: the coordinates of masks, regions and Gaussians along a few principal axes of the mask vectors.

use std::ops::Range;

use rayon::prelude::*;
use slag_math::dot;

use crate::lift::part::PartContributions;
use crate::lift::table::RegionTable;

/// Principal axes. 48 keep nine tenths of the variance of mask vectors of 512 components (measured).
pub(super) const AXES: usize = 48;

/// A vector's coordinates along the principal axes.
pub(super) type Point = [f32; AXES];

#[inline(always)]
pub(super) fn add(sum: &mut Point, weight: f32, point: &Point) {
    sum.iter_mut().zip(point).for_each(|(s, p)| *s += weight * p);
}

pub(super) fn length(point: &Point) -> f32 {
    dot(point, point).sqrt()
}

/// Scales a point to unit length; zeros stay zeros.
pub(super) fn make_unit(point: &mut Point) {
    let length = length(point);
    if length > 0.0 {
        point.iter_mut().for_each(|c| *c /= length);
    }
}

pub(super) fn of_regions(table: &RegionTable, mask_points: &[Point], regions: Range<usize>) -> Vec<Point> {
    let point = |region: usize| {
        let mut sum = [0.0; AXES];
        table.masks_of(region).for_each(|(mask, share)| add(&mut sum, share, &mask_points[mask as usize]));
        sum
    };
    regions.into_par_iter().map(point).collect()
}

/// Returns the weighted sum of the regions of some entries.
pub(super) fn sum_of(
    contributions: &PartContributions,
    entries: Range<usize>,
    region_points: &[Point],
) -> Point {
    let mut sum = [0.0; AXES];
    for (region, weight) in contributions.regions[entries.clone()].iter().zip(&contributions.weights[entries])
    {
        add(&mut sum, *weight, &region_points[*region as usize]);
    }
    sum
}
