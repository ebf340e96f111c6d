//! An upright box: a rectangle on the ground, turned about the vertical, and a range of heights.

use glam::{DVec2, DVec3};
use slag_api::objects::{Alignment, OrientedBox};
use slag_common::frames::Aabb;

use super::outline;

/// Share of the smaller of two boxes that lies in the larger one if they are of one thing.
const PIECE: f64 = 0.6;

/// An upright box in the world frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Solid {
    pub centre: DVec3,
    /// Half its edges; the first two are along `along` and to its left.
    pub half: DVec3,
    /// Unit vector of its first edge.
    pub along: DVec2,
}

impl Solid {
    /// Takes a thing's oriented box if that is upright, else its box along the world's axes.
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

    /// Takes a box along the world's axes.
    pub(crate) fn of_aabb(bounds: &Aabb) -> Self {
        Self { centre: bounds.centre(), half: bounds.size() * 0.5, along: DVec2::X }
    }

    pub fn point(at: DVec3) -> Self {
        Self { centre: at, half: DVec3::ZERO, along: DVec2::X }
    }

    /// Returns its lowest height.
    pub fn bottom(&self) -> f64 {
        self.centre.z - self.half.z
    }

    /// Returns its greatest height.
    pub fn top(&self) -> f64 {
        self.centre.z + self.half.z
    }

    pub fn height(&self) -> f64 {
        2.0 * self.half.z
    }

    pub fn volume(&self) -> f64 {
        8.0 * self.half.x * self.half.y * self.half.z
    }

    /// Returns the area of its outline on the ground.
    pub fn area(&self) -> f64 {
        4.0 * self.half.x * self.half.y
    }

    /// Returns the corners of its outline, counter-clockwise.
    pub fn corners(&self) -> [DVec2; 4] {
        let (x, y) = (self.along * self.half.x, self.along.perp() * self.half.y);
        let middle = self.centre.truncate();
        [middle - x - y, middle + x - y, middle + x + y, middle - x + y]
    }

    /// Returns the box with `by` more on every side.
    pub fn grown(&self, by: f64) -> Self {
        Self { half: self.half + DVec3::splat(by), ..*self }
    }

    /// Returns half its reach along a horizontal direction.
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

    /// Returns the length that two height ranges share, negative if there is a gap.
    pub(crate) fn shared_height(&self, other: &Self) -> f64 {
        self.top().min(other.top()) - self.bottom().max(other.bottom())
    }

    /// Returns the area that two outlines share.
    pub(crate) fn shared_area(&self, other: &Self) -> f64 {
        outline::shared_area(&self.corners(), &other.corners())
    }

    /// Returns the horizontal distance between two outlines.
    pub(crate) fn horizontal_gap(&self, other: &Self) -> f64 {
        outline::gap(&self.corners(), &other.corners())
    }

    /// Returns the distance between two boxes, 0 if they touch.
    pub fn gap(&self, other: &Self) -> f64 {
        self.horizontal_gap(other).hypot((-self.shared_height(other)).max(0.0))
    }
}
