//! The reply to `/v1/goal`.

use serde::Deserialize;

use crate::reply::Geographic;

/// Places to stand near a thing. Members that clients here do not need are left out.
#[derive(Clone, Debug, Deserialize)]
pub struct Goals {
    pub scene: String,
    /// The published state that all positions belong to.
    pub generation: u64,
    /// The thing; absent if there is no pose.
    pub thing: Option<GoalThing>,
    /// Best first.
    pub goals: Vec<Goal>,
    pub none: Option<GoalMiss>,
}

/// The thing that the poses are near.
#[derive(Clone, Debug, Deserialize)]
pub struct GoalThing {
    pub id: String,
    /// Its middle.
    pub position_in_world: [f64; 3],
}

/// A pose: the ground below the robot's middle; x forward, y left, z up.
#[derive(Clone, Debug, Deserialize)]
pub struct Goal {
    pub position_in_world: [f64; 3],
    /// The same on the earth, where the scene is geo-referenced.
    pub geographic: Option<Geographic>,
    /// Direction of x, from the world's x towards its y.
    pub yaw_rad: f64,
    /// The same as a quaternion x, y, z, w.
    pub orientation_xyzw: [f64; 4],
    /// Distance from the robot's middle to what it must not touch.
    pub clearance_m: f64,
    /// Share of the thing that is seen from there.
    pub visible_share: f64,
    /// Length of the way.
    pub path_m: f64,
}

/// Why there is no pose.
#[derive(Clone, Debug, Deserialize)]
pub struct GoalMiss {
    /// `no-such-thing`, `unreachable`, `unknown-ground` or `not-visible`.
    pub kind: String,
    /// The same in a sentence.
    pub detail: String,
}
