//! What a robot asks for, and its size.

use clap::Args;
use glam::DVec3;
use schemars::JsonSchema;
use serde::Deserialize;

use crate::query::RequestError;

pub const RADIUS_M: [f64; 2] = [0.05, 2.0];
pub const REACH_M: [f64; 2] = [0.0, 10.0];
pub const SENSOR_HEIGHT_M: [f64; 2] = [0.05, 2.3];
/// Least and largest height of the robot: places are known up to 2.4 m above a surface.
pub const HEIGHT_M: [f64; 2] = [0.05, 2.4];
pub const STEP_M: [f64; 2] = [0.0, 0.5];
/// Least step that shows in a scene, in its voxels: surface heights are known to half a voxel, so a
/// difference of n voxels may be n and a half high, and level ground may differ by one.
pub(super) const LEAST_STEP_VOXELS: f64 = 1.5;
pub const SLOPE: [f64; 2] = [0.02, 5.0];
pub const RANGE_M: [f64; 2] = [1.0, 50.0];
/// Least and largest share that must be visible.
pub const MIN_VISIBLE: [f64; 2] = [0.01, 1.0];
pub const MAX_POSES: usize = 20;

#[derive(Clone, Debug, PartialEq)]
pub enum GoalTarget {
    /// What matches a text, best first; a text may name relations, as in `/v1/query`.
    Text(String),
    Object(u64),
}

/// A robot, as flags and parameters describe it. Lengths in metres.
#[derive(Clone, Debug, PartialEq, Args, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(default)]
pub struct Robot {
    /// Radius of the robot, seen from above.
    #[arg(long, value_name = "M", default_value_t = ROBOT.radius_m)]
    #[schemars(range(min = RADIUS_M[0], max = RADIUS_M[1]), example = 0.3)]
    pub radius_m: f64,
    /// Height of its sensor above the ground.
    #[arg(long, value_name = "M", default_value_t = ROBOT.sensor_height_m)]
    #[schemars(range(min = SENSOR_HEIGHT_M[0], max = SENSOR_HEIGHT_M[1]), example = 0.4)]
    pub sensor_height_m: f64,
    /// Height of the robot; by default 0.1 above the sensor.
    #[arg(long, value_name = "M")]
    #[schemars(range(min = HEIGHT_M[0], max = HEIGHT_M[1]), example = 0.5, skip_serializing_if = "Option::is_none")]
    pub height_m: Option<f64>,
    /// Highest step that it climbs, 1.5 of the scene's voxels or more; by default 0.1, or 0.15 with voxels of 0.1 m.
    /// Heights are known to a voxel, so steps that may be higher are refused: those that look higher than half a voxel less.
    #[arg(long, value_name = "M")]
    #[schemars(range(min = STEP_M[0], max = STEP_M[1]), example = 0.1, skip_serializing_if = "Option::is_none")]
    pub step_m: Option<f64>,
    /// Steepest ground that it drives on: rise for each metre of way.
    #[arg(long, value_name = "RATIO", default_value_t = ROBOT.slope)]
    #[schemars(range(min = SLOPE[0], max = SLOPE[1]), example = 0.4)]
    pub slope: f64,
    /// How far around it ground is looked at.
    #[arg(long, value_name = "M", default_value_t = ROBOT.range_m)]
    #[schemars(range(min = RANGE_M[0], max = RANGE_M[1]), example = 20)]
    pub range_m: f64,
}

const ROBOT: Robot =
    Robot { radius_m: 0.3, sensor_height_m: 0.4, height_m: None, step_m: None, slope: 0.5, range_m: 20.0 };

impl Default for Robot {
    fn default() -> Self {
        ROBOT
    }
}

impl Robot {
    /// Returns the highest step that the robot climbs, in a scene with voxels of edge `voxel`, metres. By default
    /// 0.1 m, or up to 0.15 m where lower steps do not show in the voxels.
    pub fn step_m(&self, voxel: f64) -> f64 {
        self.step_m.unwrap_or((LEAST_STEP_VOXELS * voxel).clamp(0.1, 0.15))
    }

    pub fn height(&self) -> f64 {
        self.height_m.unwrap_or(self.sensor_height_m + 0.1)
    }
}

/// Which places count, as flags and parameters say it.
#[derive(Clone, Debug, PartialEq, Args, Deserialize, JsonSchema)]
#[schemars(inline)]
#[serde(default)]
pub struct Stand {
    /// Largest horizontal distance from the robot's middle to the thing's surface.
    #[arg(long, value_name = "M", default_value_t = STAND.reach_m)]
    #[schemars(range(min = REACH_M[0], max = REACH_M[1]), example = 0.8)]
    pub reach_m: f64,
    /// Least share of the thing's Gaussians that the sensor must see.
    #[arg(long, value_name = "SHARE", default_value_t = STAND.min_visible)]
    #[schemars(range(min = MIN_VISIBLE[0], max = MIN_VISIBLE[1]), example = 0.05)]
    pub min_visible: f64,
    /// Most poses.
    #[arg(long, default_value_t = STAND.limit)]
    #[schemars(range(min = 1, max = MAX_POSES), example = 3)]
    pub limit: usize,
}

const STAND: Stand = Stand { reach_m: 0.8, min_visible: 0.02, limit: 3 };

impl Default for Stand {
    fn default() -> Self {
        STAND
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct GoalRequest {
    pub target: GoalTarget,
    /// Robot's position, world frame; the centre of the area on board if absent.
    pub near: Option<DVec3>,
    /// Robot's heading, radians from the world's x axis towards y, for texts that depend on it.
    pub heading_rad: Option<f64>,
    pub robot: Robot,
    pub stand: Stand,
}

impl GoalRequest {
    /// Asks for places to stand near a thing, for the default robot of flags and parameters.
    pub fn new(target: GoalTarget) -> Self {
        Self { target, near: None, heading_rad: None, robot: ROBOT, stand: STAND }
    }

    /// Checks every limit that does not depend on the scene.
    pub fn check(&self) -> Result<(), RequestError> {
        let Self { robot, stand, .. } = self;
        let ranges = [
            ("radius_m", robot.radius_m, RADIUS_M),
            ("reach_m", stand.reach_m, REACH_M),
            ("sensor_height_m", robot.sensor_height_m, SENSOR_HEIGHT_M),
            ("height_m", robot.height(), [robot.sensor_height_m, HEIGHT_M[1]]),
            ("step_m", robot.step_m.unwrap_or(STEP_M[0]), STEP_M),
            ("slope", robot.slope, SLOPE),
            ("range_m", robot.range_m, RANGE_M),
            ("min_visible", stand.min_visible, MIN_VISIBLE),
        ];
        for (name, value, [low, high]) in ranges {
            if !(low..=high).contains(&value) {
                return Err(RequestError::new(name, &value.to_string(), format!("{low} to {high}")));
            }
        }
        if !(1..=MAX_POSES).contains(&stand.limit) {
            let expected = format!("1 to {MAX_POSES} poses");
            return Err(RequestError::new("limit", &stand.limit.to_string(), expected));
        }
        match self.near {
            Some(near) if !near.is_finite() || near.abs().max_element() >= 1e9 => {
                Err(RequestError::new("near", &near.to_string(), "a position within a million kilometres"))
            }
            _ => Ok(()),
        }
    }
}
