//! An upright box: a rectangle on the ground, turned about the vertical, and a range of heights.

use glam::{DVec2, DVec3};
use slag_api::objects::{Alignment, OrientedBox};
use slag_common::frames::Aabb;

/// Share of the smaller of two boxes inside the larger from which they are one thing.
const PIECE: f64 = 0.6;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Solid {
    pub centre: DVec3,
    /// Half its edges; the first two along `along` and to its left.
    pub half: DVec3,
    /// Unit vector of its first edge.
    pub along: DVec2,
}

impl Solid {
    /// Takes a thing's oriented box if upright, else its box along the world's axes.
    pub fn of(oriented: &OrientedBox, bounds: &Aabb) -> Self {
        match oriented.alignment {
            Alignment::Gravity => {
                let along = (oriented.rotation_world_from_box * DVec3::X).truncate();
                let along = along.try_normalize().unwrap_or(DVec2::X);
                Self { centre: oriented.centre_in_world, half: oriented.size * 0.5, along }
            }
            Alignment::Principal => Self::of_aabb(bounds),
        }
    }

    pub(crate) fn of_aabb(bounds: &Aabb) -> Self {
        Self { centre: bounds.centre(), half: bounds.size() * 0.5, along: DVec2::X }
    }

    pub fn point(at: DVec3) -> Self {
        Self { centre: at, half: DVec3::ZERO, along: DVec2::X }
    }

    pub fn bottom(&self) -> f64 {
        self.centre.z - self.half.z
    }

    pub fn top(&self) -> f64 {
        self.centre.z + self.half.z
    }

    pub fn height(&self) -> f64 {
        2.0 * self.half.z
    }

    pub fn volume(&self) -> f64 {
        8.0 * self.half.x * self.half.y * self.half.z
    }

    pub fn area(&self) -> f64 {
        4.0 * self.half.x * self.half.y
    }

    /// Returns the corners of its outline, counter-clockwise.
    pub fn corners(&self) -> [DVec2; 4] {
        let (x, y) = (self.along * self.half.x, self.along.perp() * self.half.y);
        let middle = self.centre.truncate();
        [middle - x - y, middle + x - y, middle + x + y, middle - x + y]
    }

    pub fn grown(&self, by: f64) -> Self {
        Self { half: self.half + DVec3::splat(by), ..*self }
    }

    /// Returns the smallest box around both along its own edges.
    pub(crate) fn joined(&self, other: &Self) -> Self {
        let across = self.along.perp();
        let range = |direction: DVec2| {
            let places =
                self.corners().into_iter().chain(other.corners()).map(|corner| corner.dot(direction));
            places.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], at| [low.min(at), high.max(at)])
        };
        let heights = [self.bottom().min(other.bottom()), self.top().max(other.top())];
        let [x, y, z] = [range(self.along), range(across), heights];
        let middle = |[low, high]: [f64; 2]| (low + high) / 2.0;
        let half = |[low, high]: [f64; 2]| (high - low) / 2.0;
        Self {
            centre: (self.along * middle(x) + across * middle(y)).extend(middle(z)),
            half: DVec3::new(half(x), half(y), half(z)),
            along: self.along,
        }
    }

    /// Returns half its extent along a horizontal direction.
    pub fn reach(&self, direction: DVec2) -> f64 {
        self.half.x * direction.dot(self.along).abs() + self.half.y * direction.dot(self.along.perp()).abs()
    }

    /// Returns whether most of the smaller of two boxes lies in the other, or sticks out by at most `slack`.
    pub(crate) fn is_piece_of(&self, other: &Self, slack: f64) -> bool {
        let (small, large) = if self.volume() <= other.volume() { (self, other) } else { (other, self) };
        let large = large.grown(slack);
        let of_outline = small.shared_area(&large) / small.area().max(f64::MIN_POSITIVE);
        let of_height = small.shared_height(&large).max(0.0) / small.height().max(f64::MIN_POSITIVE);
        of_outline * of_height >= PIECE
    }

    /// Returns the overlap of two height ranges, negative for a gap.
    pub(crate) fn shared_height(&self, other: &Self) -> f64 {
        self.top().min(other.top()) - self.bottom().max(other.bottom())
    }

    pub(crate) fn shared_area(&self, other: &Self) -> f64 {
        shared_area(&self.corners(), &other.corners())
    }

    pub(crate) fn horizontal_gap(&self, other: &Self) -> f64 {
        outline_gap(&self.corners(), &other.corners())
    }

    /// Returns the distance between two boxes, 0 if they touch.
    pub fn gap(&self, other: &Self) -> f64 {
        self.horizontal_gap(other).hypot((-self.shared_height(other)).max(0.0))
    }
}

/// Returns the overlap area of two convex outlines, both counter-clockwise (Sutherland and Hodgman, 1974).
fn shared_area(a: &[DVec2], b: &[DVec2]) -> f64 {
    let mut shared: Vec<DVec2> = a.to_vec();
    for (from, to) in edges(b) {
        let side = |p: DVec2| (to - from).perp_dot(p - from);
        let mut kept = Vec::with_capacity(shared.len() + 1);
        for (p, q) in edges(&shared) {
            let (of_p, of_q) = (side(p), side(q));
            if of_p >= 0.0 {
                kept.push(p);
            }
            if of_p * of_q < 0.0 {
                kept.push(p + (q - p) * (of_p / (of_p - of_q)));
            }
        }
        shared = kept;
    }
    edges(&shared).map(|(p, q)| p.perp_dot(q)).sum::<f64>().max(0.0) * 0.5
}

/// Returns the distance between two convex outlines, 0 if they share a point.
fn outline_gap(a: &[DVec2], b: &[DVec2]) -> f64 {
    if contains(a, b[0]) || contains(b, a[0]) {
        return 0.0;
    }
    let pairs = edges(a).flat_map(|one| edges(b).map(move |other| (one, other)));
    pairs.map(|(one, other)| between_segments(one, other)).fold(f64::INFINITY, f64::min)
}

fn edges(of: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> {
    (0..of.len()).map(move |at| (of[at], of[(at + 1) % of.len()]))
}

/// Whether an outline with an area contains a point; the asker's outline has none.
fn contains(of: &[DVec2], point: DVec2) -> bool {
    edges(of).map(|(p, q)| p.perp_dot(q)).sum::<f64>() > 0.0
        && edges(of).all(|(from, to)| (to - from).perp_dot(point - from) >= 0.0)
}

fn between_segments(a: (DVec2, DVec2), b: (DVec2, DVec2)) -> f64 {
    let side = |(from, to): (DVec2, DVec2), p: DVec2| (to - from).perp_dot(p - from);
    let crosses = |one, other: (DVec2, DVec2)| side(one, other.0) * side(one, other.1) < 0.0;
    if crosses(a, b) && crosses(b, a) {
        return 0.0;
    }
    let ends = [to_segment(a.0, b), to_segment(a.1, b), to_segment(b.0, a), to_segment(b.1, a)];
    ends.into_iter().fold(f64::INFINITY, f64::min)
}

pub fn to_segment(point: DVec2, (from, to): (DVec2, DVec2)) -> f64 {
    let along = to - from;
    let at = (point - from).dot(along) / along.length_squared().max(f64::MIN_POSITIVE);
    point.distance(from + along * at.clamp(0.0, 1.0))
}
