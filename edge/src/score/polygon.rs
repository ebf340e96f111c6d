//! A polygon on the ground, for asking about a room or a yard that is no box.

use glam::DVec2;
use slag_common::frames::Aabb;

use super::error::MAX_COORDINATE;

pub const MAX_CORNERS: usize = 256;

/// A polygon in the world's x and y, of any height. It may be concave; where it crosses itself, even-odd counts.
#[derive(Clone, Debug, PartialEq)]
pub struct Polygon {
    corners: Vec<DVec2>,
    min: DVec2,
    max: DVec2,
}

impl Polygon {
    /// Takes 3 to [`MAX_CORNERS`] corners, in either direction; `None` for another number, corners out of bounds or
    /// all on one line, which has no inside.
    pub fn new(corners: Vec<DVec2>) -> Option<Self> {
        let is_within = |corner: &DVec2| corner.is_finite() && corner.abs().max_element() <= MAX_COORDINATE;
        if !(3..=MAX_CORNERS).contains(&corners.len()) || !corners.iter().all(is_within) {
            return None;
        }
        let from_first = |corner: &DVec2| *corner - corners[0];
        let along = corners
            .iter()
            .map(from_first)
            .fold(DVec2::ZERO, |far, to| if to.length_squared() > far.length_squared() { to } else { far });
        if corners.iter().map(from_first).all(|to| along.perp_dot(to) == 0.0) {
            return None;
        }
        let min = corners.iter().copied().fold(DVec2::INFINITY, DVec2::min);
        let max = corners.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
        Some(Self { corners, min, max })
    }

    pub fn corners(&self) -> &[DVec2] {
        &self.corners
    }

    fn edges(&self) -> impl Iterator<Item = (DVec2, DVec2)> + '_ {
        let n = self.corners.len();
        (0..n).map(move |at| (self.corners[at], self.corners[(at + 1) % n]))
    }

    /// Returns whether a point lies inside: a ray along x crosses an odd number of edges. A point on the border
    /// may lie on either side.
    pub fn contains(&self, point: DVec2) -> bool {
        let crosses = |(a, b): (DVec2, DVec2)| {
            (a.y > point.y) != (b.y > point.y) && point.x < (b.x - a.x) * (point.y - a.y) / (b.y - a.y) + a.x
        };
        self.edges().filter(|edge| crosses(*edge)).count() % 2 == 1
    }

    /// Returns whether every point of a box lies inside. May be false although all do, if an edge passes close by.
    pub fn covers(&self, of: &Aabb) -> bool {
        let (min, max) = (of.min.truncate(), of.max.truncate());
        let passes = |(a, b): (DVec2, DVec2)| a.min(b).cmple(max).all() && a.max(b).cmpge(min).all();
        !self.edges().any(passes) && self.contains(min)
    }

    /// Returns whether a point of a box can lie inside. May be true although none does.
    pub fn touches(&self, of: &Aabb) -> bool {
        of.min.truncate().cmple(self.max).all() && of.max.truncate().cmpge(self.min).all()
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::*;

    /// Returns how often a polygon winds around a point: the sum of the angles of its edges, seen from there.
    fn turns(polygon: &Polygon, point: DVec2) -> i64 {
        let angle = |(a, b): (DVec2, DVec2)| (a - point).angle_to(b - point);
        (polygon.edges().map(angle).sum::<f64>() / std::f64::consts::TAU).round() as i64
    }

    proptest! {
        /// Oracle: winding numbers, which are odd where even-odd says inside; boxes by their lattice points.
        #[test]
        fn points_are_inside_as_the_winding_number_says(
            corners in prop::collection::vec(prop::array::uniform2(-4.0f64..4.0), 3..9),
            a in prop::array::uniform2(-5.0f64..5.0), size in prop::array::uniform2(0.0f64..2.0),
        ) {
            let polygon = Polygon::new(corners.into_iter().map(DVec2::from).collect()).expect("valid");
            let (min, size) = (DVec2::from(a), DVec2::from(size));
            let of = Aabb { min: min.extend(-1.0), max: (min + size).extend(1.0) };
            let lattice = || (0..=8).flat_map(|x| (0..=8).map(move |y| DVec2::new(x.into(), y.into()) / 8.0));
            let mut inside = lattice().map(|at| polygon.contains(min + size * at));
            let all = lattice().zip(inside.by_ref()).fold((true, false), |(all, any), (at, is_inside)| {
                assert_eq!(is_inside, turns(&polygon, min + size * at) % 2 != 0);
                (all && is_inside, any || is_inside)
            });
            prop_assert!(!polygon.covers(&of) || all.0);
            prop_assert!(polygon.touches(&of) || !all.1);
        }
    }

    #[test]
    fn limits_are_kept() {
        let corner = |i: usize| DVec2::new(i as f64, (i * i) as f64);
        for (n, is_valid) in [(2, false), (3, true), (MAX_CORNERS, true), (MAX_CORNERS + 1, false)] {
            assert_eq!(Polygon::new((0..n).map(corner).collect()).is_some(), is_valid, "{n}");
        }
        assert!(Polygon::new(vec![DVec2::ZERO, DVec2::X, DVec2::new(f64::NAN, 0.0)]).is_none());
        assert!(Polygon::new(vec![DVec2::ZERO, DVec2::X, DVec2::new(0.0, 1e10)]).is_none());
        let square = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)].map(|(x, y)| DVec2::new(x, y));
        let square = Polygon::new(square.to_vec()).expect("valid");
        let inner = Aabb { min: DVec3::splat(1.0), max: DVec3::splat(2.0) };
        assert!(square.covers(&inner) && square.touches(&inner));
    }
}
