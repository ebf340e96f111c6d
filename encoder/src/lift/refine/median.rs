//! Moves a Gaussian's embedding from the mean of its views to their geometric median, so that views that disagree count
//! less (Weiszfeld 1937).

use slag_math::dot;

use super::points::{AXES, Point, add, length, make_unit, sum_of};
use super::views::ViewEntries;
use crate::lift::part::PartContributions;

/// Distance on the unit sphere below which views count as equal: it bounds a view's factor.
const RESOLUTION: f32 = 0.1;

/// Returns a factor for each view of a Gaussian after some steps.
pub(super) fn factors(
    contributions: &PartContributions,
    views: &[ViewEntries],
    region_points: &[Point],
    steps: u32,
) -> Vec<f32> {
    let mut of_views: Vec<Point> =
        views.iter().map(|view| sum_of(contributions, view.entries.clone(), region_points)).collect();
    let weights: Vec<f32> = of_views.iter().map(length).collect();
    of_views.iter_mut().for_each(make_unit);
    let mut factors = vec![1.0; views.len()];
    for _ in 0..steps {
        let mut median = [0.0; AXES];
        for ((point, weight), factor) in of_views.iter().zip(&weights).zip(&factors) {
            add(&mut median, weight * factor, point);
        }
        make_unit(&mut median);
        for (factor, point) in factors.iter_mut().zip(&of_views) {
            let distance = (2.0 - 2.0 * dot(point, &median)).max(0.0).sqrt();
            *factor = RESOLUTION / distance.max(RESOLUTION);
        }
    }
    factors
}
