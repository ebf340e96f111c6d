//! `GET /v1/goal`.

use std::borrow::Cow;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{FRAME, Geographic};

/// A pose to stand in, in the scene's world frame: x forward, y left, z up (REP-103).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Goal {
    /// The ground below the robot's middle.
    #[schemars(with = "[f64; 3]")]
    pub position_in_world: DVec3,
    /// The same on the earth, if the scene is geo-referenced.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geographic: Option<Geographic>,
    /// Direction of x, towards the middle of what is seen: from the world's x towards its y.
    pub yaw_rad: f64,
    /// The same as a quaternion: x, y, z, w.
    pub orientation_xyzw: [f64; 4],
    /// The sensor.
    #[schemars(with = "[f64; 3]")]
    pub sensor_in_world: DVec3,
    /// Horizontal distance from the robot's middle to what it must not touch.
    pub clearance_m: f64,
    /// Share of the thing's sampled Gaussians that the sensor sees.
    pub visible_share: f64,
    /// Length of the way, along eight directions: up to 8 % longer than a straight one.
    pub path_m: f64,
    /// Horizontal distance from the robot's middle to the thing's surface.
    pub distance_m: f64,
    /// What the poses are ordered by: way, clearance and sight, in metres of way.
    pub cost_m: f64,
}

/// Why there is no pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum NoGoal {
    /// Nothing on board matches.
    NoSuchThing,
    /// No way leads within reach of it.
    Unreachable,
    /// The ground around it, or below the robot, is not known.
    UnknownGround,
    /// From no place within reach enough of it is seen.
    NotVisible,
}

/// Why there is no pose, for programs and people.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GoalMiss {
    /// The reason.
    pub kind: NoGoal,
    /// The reason in words, with figures.
    pub detail: String,
}

/// The thing to go to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "GoalThing")]
pub struct TargetThing {
    /// Its id.
    pub id: String,
    /// Mean of its Gaussians.
    #[schemars(with = "[f64; 3]")]
    pub position_in_world: DVec3,
    /// Its score with the text; absent if it was asked for by id.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub score: Option<f32>,
}

/// A thing that matches better, but without a pose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MissedThing {
    /// The thing.
    #[serde(flatten)]
    pub thing: TargetThing,
    /// Why it has no pose.
    pub none: NoGoal,
}

/// The places to stand.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GoalReply {
    /// Name of the scene.
    pub scene: String,
    /// Its generation.
    pub generation: u64,
    /// Frame of every position.
    #[schemars(extend("enum" = [FRAME]))]
    pub frame: Cow<'static, str>,
    /// Edge of the voxels that places are known by.
    pub voxel_m: f64,
    /// Where the robot was taken to be.
    #[schemars(with = "[f64; 3]")]
    pub near_in_world: DVec3,
    /// The best match with a pose.
    pub thing: Option<TargetThing>,
    /// The poses, best first.
    pub goals: Vec<Goal>,
    /// Why there is none.
    pub none: Option<GoalMiss>,
    /// Better matches without a pose, best first.
    pub missed: Vec<MissedThing>,
}

impl GoalReply {
    pub fn empty(scene: &str, generation: u64, voxel_m: f64, near_in_world: DVec3) -> Self {
        Self {
            scene: scene.to_owned(),
            generation,
            frame: FRAME.into(),
            voxel_m,
            near_in_world,
            thing: None,
            goals: Vec::new(),
            none: None,
            missed: Vec::new(),
        }
    }
}
