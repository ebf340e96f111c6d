//! The part of space that a question asks about.

use std::fmt;
use std::sync::Arc;

use glam::DVec3;
use slag_common::frames::Aabb;

use super::polygon::Polygon;

/// A ball in the world frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    pub centre_in_world: DVec3,
    /// Its radius, world units.
    pub radius: f64,
}

impl Ball {
    fn contains(&self, point: DVec3) -> bool {
        point.distance_squared(self.centre_in_world) <= self.radius * self.radius
    }
}

/// A ball, a box and a polygon, each optional. A Gaussian lies inside if its mean lies in all of them; the borders
/// of ball and box are included.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Region {
    pub ball: Option<Ball>,
    /// The box, aligned with the world's axes.
    pub bounds: Option<Aabb>,
    /// The polygon, seen from above.
    pub polygon: Option<Arc<Polygon>>,
}

impl Region {
    /// Returns whether a point lies inside.
    pub fn contains(&self, point: DVec3) -> bool {
        self.ball.is_none_or(|ball| ball.contains(point))
            && self.bounds.is_none_or(|bounds| bounds.contains(point))
            && self.polygon.as_ref().is_none_or(|polygon| polygon.contains(point.truncate()))
    }

    /// Returns whether every point of a box lies inside.
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

    /// Returns whether a point of a box can lie inside. May be true although none does, if ball and bounds
    /// touch the box in different places.
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

#[cfg(test)]
mod tests {
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
            // Corners decide, and they are in the lattice.
            prop_assert_eq!(region.covers(&of), lattice.iter().all(inside));
        }
    }
}
