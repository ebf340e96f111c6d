//! What a robot asks for, and its size.

use glam::DVec3;

use crate::query::{QueryError, RequestError};
use crate::score::{OverBudget, ScoreError};

/// Least and largest radius of the robot.
pub const RADIUS_M: [f64; 2] = [0.05, 2.0];
/// Least and largest reach.
pub const REACH_M: [f64; 2] = [0.0, 10.0];
/// Least and largest height of the sensor.
pub const SENSOR_HEIGHT_M: [f64; 2] = [0.05, 2.3];
/// Least and largest height of the robot: places are known up to 2.4 m above a surface.
pub const HEIGHT_M: [f64; 2] = [0.05, 2.4];
/// Least and largest step.
pub const STEP_M: [f64; 2] = [0.0, 0.5];
/// Least step that shows in a scene, in its voxels: heights of surfaces are known to half a voxel, so a difference
/// of n voxels may be n and a half high, and level ground may differ by one.
pub(super) const LEAST_STEP_VOXELS: f64 = 1.5;
/// Least and largest slope.
pub const SLOPE: [f64; 2] = [0.02, 5.0];
/// Least and largest range.
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

/// A request for places to stand. Lengths in metres.
#[derive(Clone, Debug, PartialEq)]
pub struct GoalRequest {
    pub target: GoalTarget,
    /// Where the robot is, world frame; the centre of the area on board if absent.
    pub near: Option<DVec3>,
    /// Radius of the robot's outline, seen from above.
    pub radius_m: f64,
    /// Largest horizontal distance from the robot's middle to the thing's surface.
    pub reach_m: f64,
    /// Height of the sensor above the ground.
    pub sensor_height_m: f64,
    /// Height of the robot; 0.1 m above the sensor if absent.
    pub height_m: Option<f64>,
    /// Highest step that it climbs; see [`GoalRequest::step_m`] if absent.
    pub step_m: Option<f64>,
    /// Steepest ground that it drives on, rise for each metre of way; a step is allowed besides.
    pub slope: f64,
    /// How far around the robot ground is looked at.
    pub range_m: f64,
    /// Least share of the thing's Gaussians that the sensor must see.
    pub min_visible: f64,
    /// Most poses.
    pub limit: usize,
}

impl GoalRequest {
    /// Asks for places to stand near a thing, for a robot of 0.3 m radius with a sensor 0.4 m above the ground.
    pub fn new(target: GoalTarget) -> Self {
        Self {
            target,
            near: None,
            radius_m: 0.3,
            reach_m: 0.8,
            sensor_height_m: 0.4,
            height_m: None,
            step_m: None,
            slope: 0.5,
            range_m: 20.0,
            min_visible: 0.02,
            limit: 3,
        }
    }

    /// Returns the highest step that the robot climbs, in a scene with voxels of edge `voxel`, metres. By default
    /// 0.1 m, or up to 0.15 m where lower steps do not show in the voxels.
    pub fn step_m(&self, voxel: f64) -> f64 {
        self.step_m.unwrap_or((LEAST_STEP_VOXELS * voxel).clamp(0.1, 0.15))
    }

    pub fn height(&self) -> f64 {
        self.height_m.unwrap_or(self.sensor_height_m + 0.1)
    }

    /// Checks every limit that does not depend on the scene.
    pub fn check(&self) -> Result<(), RequestError> {
        let ranges = [
            ("radius_m", self.radius_m, RADIUS_M),
            ("reach_m", self.reach_m, REACH_M),
            ("sensor_height_m", self.sensor_height_m, SENSOR_HEIGHT_M),
            ("height_m", self.height(), [self.sensor_height_m, HEIGHT_M[1]]),
            ("step_m", self.step_m.unwrap_or(STEP_M[0]), STEP_M),
            ("slope", self.slope, SLOPE),
            ("range_m", self.range_m, RANGE_M),
            ("min_visible", self.min_visible, MIN_VISIBLE),
        ];
        for (name, value, [low, high]) in ranges {
            if !(low..=high).contains(&value) {
                return Err(RequestError::new(name, &value.to_string(), format!("{low} to {high}")));
            }
        }
        if !(1..=MAX_POSES).contains(&self.limit) {
            let expected = format!("1 to {MAX_POSES} poses");
            return Err(RequestError::new("limit", &self.limit.to_string(), expected));
        }
        match self.near {
            Some(near) if !near.is_finite() || near.abs().max_element() >= 1e9 => {
                Err(RequestError::new("near", &near.to_string(), "a position within a million kilometres"))
            }
            _ => Ok(()),
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum GoalError {
    #[error(transparent)]
    Query(#[from] QueryError),
    #[error(
        "the scene does not say which places are free; encode it with --occupancy, publish it, and fetch it again"
    )]
    NoOccupancy,
    #[error(
        "the scene has no objects to go to; encode it without --no-objects, publish it, and fetch it again"
    )]
    NoObjects,
}

impl From<RequestError> for GoalError {
    fn from(error: RequestError) -> Self {
        Self::Query(error.into())
    }
}

impl GoalError {
    pub(super) fn spent(error: OverBudget) -> Self {
        Self::Query(ScoreError::from(error).into())
    }

    /// Returns the stable name of the error's kind, for programs.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Query(error) => error.kind(),
            Self::NoOccupancy => "no-occupancy",
            Self::NoObjects => "no-objects",
        }
    }
}
