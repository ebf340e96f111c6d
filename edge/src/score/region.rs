//! The region of a question.

use std::fmt;
use std::sync::Arc;

use glam::{DVec2, DVec3};
use slag_common::frames::Aabb;

use super::budget::MAX_COORDINATE;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    pub centre_in_world: DVec3,
    pub radius: f64,
}

impl Ball {
    fn contains(&self, point: DVec3) -> bool {
        point.distance_squared(self.centre_in_world) <= self.radius * self.radius
    }
}

/// A ball, box and polygon, each optional; a mean must lie in all. The borders of ball and box are included.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Region {
    pub ball: Option<Ball>,
    pub bounds: Option<Aabb>,
    /// The polygon, seen from above.
    pub polygon: Option<Arc<Polygon>>,
}

impl Region {
    pub fn contains(&self, point: DVec3) -> bool {
        self.ball.is_none_or(|ball| ball.contains(point))
            && self.bounds.is_none_or(|bounds| bounds.contains(point))
            && self.polygon.as_ref().is_none_or(|polygon| polygon.contains(point.truncate()))
    }

    pub fn covers(&self, of: &Aabb) -> bool {
        // Rounded as in `contains`; the rounding grows with every component.
        let in_ball = |ball: Ball| {
            let farthest = (of.min - ball.centre_in_world).abs().max((of.max - ball.centre_in_world).abs());
            farthest.length_squared() <= ball.radius * ball.radius
        };
        self.ball.is_none_or(in_ball)
            && self.bounds.is_none_or(|b| of.min.cmpge(b.min).all() && of.max.cmple(b.max).all())
            && self.polygon.as_ref().is_none_or(|polygon| polygon.covers(of))
    }

    /// Returns whether a point of a box can lie inside. May be true although none does, if ball and bounds touch the
    /// box in different places.
    pub fn touches(&self, of: &Aabb) -> bool {
        let near = |ball: Ball| ball.contains(ball.centre_in_world.clamp(of.min, of.max));
        self.ball.is_none_or(near)
            && self.bounds.is_none_or(|b| of.min.cmple(b.max).all() && of.max.cmpge(b.min).all())
            && self.polygon.as_ref().is_none_or(|polygon| polygon.touches(of))
    }
}

impl fmt::Display for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(ball) = &self.ball {
            write!(f, " within {} of {}", ball.radius, ball.centre_in_world)?;
        }
        if let Some(bounds) = &self.bounds {
            write!(f, " in the box {} to {}", bounds.min, bounds.max)?;
        }
        if let Some(polygon) = &self.polygon {
            write!(f, " in a polygon of {} corners", polygon.corners().len())?;
        }
        Ok(())
    }
}

pub const MAX_CORNERS: usize = 256;

/// A polygon in the world's x and y, unbounded in height. May be concave; self-intersections count even-odd.
#[derive(Clone, Debug, PartialEq)]
pub struct Polygon {
    corners: Vec<DVec2>,
    min: DVec2,
    max: DVec2,
}

impl Polygon {
    /// Takes 3 to [`MAX_CORNERS`] corners, in either direction; `None` for others, out of bounds, or all on one line.
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

    /// Returns whether a point lies inside: a ray along x crosses an odd number of edges. Borders may count either
    /// way.
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

    fn corner() -> impl Strategy<Value = DVec3> {
        prop::array::uniform3(-8i32..8).prop_map(|c| DVec3::from(c.map(|v| f64::from(v) / 2.0)))
    }

    proptest! {
        /// Oracle: every lattice point of a box, one by one. Distances up to 14 in steps of 1/2 are exact.
        #[test]
        fn boxes_are_covered_or_touched_as_their_points_are(
            a in corner(), b in corner(), centre in prop::option::of((corner(), 0u32..20)),
            bounds in prop::option::of((corner(), corner())),
        ) {
            let of = Aabb { min: a.min(b), max: a.max(b) };
            let region = Region {
                ball: centre.map(|(centre_in_world, r)| Ball { centre_in_world, radius: f64::from(r) / 2.0 }),
                bounds: bounds.map(|(a, b)| Aabb { min: a.min(b), max: a.max(b) }),
                polygon: None,
            };
            let steps = of.size() * 2.0;
            let along = |axis: usize| 0..=steps[axis] as i32;
            let lattice: Vec<DVec3> = along(0)
                .flat_map(|x| along(1).flat_map(move |y| along(2).map(move |z| DVec3::new(x.into(), y.into(), z.into()))))
                .map(|step| of.min + step * 0.5)
                .collect();
            let inside = |p: &DVec3| {
                let in_ball = region.ball.is_none_or(|ball| (*p - ball.centre_in_world).length() <= ball.radius);
                in_ball && region.bounds.is_none_or(|b| (0..3).all(|i| (b.min[i]..=b.max[i]).contains(&p[i])))
            };
            prop_assert!(lattice.iter().all(|p| region.contains(*p) == inside(p)));
            prop_assert!(!region.covers(&of) || lattice.iter().all(inside));
            prop_assert!(region.touches(&of) || !lattice.iter().any(inside));
            // Corners decide, and the lattice includes them.
            prop_assert_eq!(region.covers(&of), lattice.iter().all(inside));
        }
    }

    /// Returns the winding number of a polygon around a point, from the angles of its edges.
    fn turns(polygon: &Polygon, point: DVec2) -> i64 {
        let angle = |(a, b): (DVec2, DVec2)| (a - point).angle_to(b - point);
        (polygon.edges().map(angle).sum::<f64>() / std::f64::consts::TAU).round() as i64
    }

    proptest! {
        /// Oracle: winding numbers, odd where even-odd says inside; boxes by their lattice points.
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
