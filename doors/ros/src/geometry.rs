//! Points, rotations and poses of `geometry_msgs`.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// `geometry_msgs/Point`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Point {
    pub x: f64,
    pub y: f64,
    pub z: f64,
}

/// `geometry_msgs/Vector3`, which is the same on the wire.
pub type Vector3 = Point;

/// `geometry_msgs/Quaternion`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quaternion {
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub w: f64,
}

/// `geometry_msgs/Pose`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    pub position: Point,
    pub orientation: Quaternion,
}

/// A rigid motion: `p_parent = rotation * p_child + translation`.
#[derive(Clone, Copy, Debug)]
pub struct Rigid {
    rotation: DQuat,
    translation: DVec3,
}

impl From<[f64; 3]> for Point {
    fn from([x, y, z]: [f64; 3]) -> Self {
        Self { x, y, z }
    }
}

impl From<Point> for [f64; 3] {
    fn from(Point { x, y, z }: Point) -> Self {
        [x, y, z]
    }
}

impl From<[f64; 4]> for Quaternion {
    fn from([x, y, z, w]: [f64; 4]) -> Self {
        Self { x, y, z, w }
    }
}

impl Quaternion {
    pub const IDENTITY: Self = Self { x: 0.0, y: 0.0, z: 0.0, w: 1.0 };
}

impl Pose {
    /// A position without rotation.
    pub fn at(position: [f64; 3]) -> Self {
        Self { position: position.into(), orientation: Quaternion::IDENTITY }
    }
}

impl Rigid {
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Parses a transform; `None` if it is not finite, or has a zero quaternion.
    pub fn new(translation: Vector3, rotation: Quaternion) -> Option<Self> {
        let translation = DVec3::from_array(translation.into());
        let rotation = DQuat::from_xyzw(rotation.x, rotation.y, rotation.z, rotation.w);
        let is_sound = translation.is_finite() && rotation.is_finite() && rotation.length_squared() > 1e-6;
        is_sound.then(|| Self { rotation: rotation.normalize(), translation })
    }

    /// Composes motions: `parent_from_child.after(child_from_grandchild)`.
    pub fn after(self, other: Self) -> Self {
        Self {
            rotation: self.rotation * other.rotation,
            translation: self.rotation * other.translation + self.translation,
        }
    }

    pub fn inverse(self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: rotation * -self.translation }
    }

    pub fn apply(self, point: [f64; 3]) -> [f64; 3] {
        (self.rotation * DVec3::from_array(point) + self.translation).to_array()
    }

    pub fn angle(self) -> f64 {
        self.rotation.angle_between(DQuat::IDENTITY)
    }

    /// Rotates a direction from the parent's to the child's frame.
    pub fn to_child(self, direction: [f64; 3]) -> [f64; 3] {
        (self.rotation.inverse() * DVec3::from_array(direction)).to_array()
    }

    pub fn quaternion(self) -> Quaternion {
        self.rotation.to_array().into()
    }

    pub fn pose(self) -> Pose {
        Pose { position: self.origin().into(), orientation: self.quaternion() }
    }

    pub fn origin(self) -> [f64; 3] {
        self.translation.to_array()
    }
}
