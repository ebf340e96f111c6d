//! The robot that places are asked for.

/// Largest horizontal distance to the thing.
pub const REACH_M: f64 = 0.8;
/// Height of the sensor.
pub const SENSOR_HEIGHT_M: f64 = 0.4;
/// Height of the robot.
pub const HEIGHT_M: f64 = 0.5;
/// Highest step.
pub const STEP_M: f64 = 0.1;
/// Least share of the thing's Gaussians that must be seen. From one side hardly half of them are.
pub const MIN_VISIBLE: f64 = 0.02;
/// Least share of the thing's outline that must truly be shown.
pub const MIN_SHOWN: f64 = 0.1;
