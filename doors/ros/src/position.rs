//! The robot's position from ROS messages.

use serde_json::{Value, json};

use crate::messages::{NavSatFix, Odometry};
use crate::transforms::Transforms;

/// Returns the position of a robot's frame, if connected to the scene's.
pub fn of_frame(frames: &Transforms, scene_frame: &str, base_frame: &str) -> Option<[f64; 3]> {
    frames.target_from(scene_frame, base_frame).map(|base| base.origin())
}

/// Returns odometry's position; `None` while its frame is not connected to the scene's. Odometry drifts, so its frame
/// is not the scene's unless a localiser connects them.
pub fn of_odometry(frames: &Transforms, scene_frame: &str, odometry: &Odometry) -> Option<[f64; 3]> {
    let scene_from_odometry = frames.target_from(scene_frame, &odometry.header.frame_id)?;
    let position: [f64; 3] = odometry.pose.pose.position.into();
    position.iter().all(|x| x.is_finite()).then(|| scene_from_odometry.apply(position))
}

/// Converts a fix for the robot's program; `None` if invalid.
pub fn of_fix(fix: &NavSatFix) -> Option<Value> {
    let (lat, lon) = (fix.latitude, fix.longitude);
    let is_fix = fix.status >= 0 && lat.is_finite() && lon.is_finite();
    let mut place = json!({"lat": lat, "lon": lon});
    // Receivers without a height send NaN; the robot's program then takes the scene's.
    if fix.altitude.is_finite() {
        place["height"] = json!(fix.altitude);
    }
    is_fix.then_some(place)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::answers::header;

    #[test]
    fn only_a_fix_is_a_place() {
        let fix = NavSatFix {
            header: header("gps"),
            status: 0,
            service: 1,
            latitude: 47.3,
            longitude: 8.5,
            altitude: f64::NAN,
        };
        assert_eq!(of_fix(&fix), Some(json!({"lat": 47.3, "lon": 8.5})));
        let high = of_fix(&NavSatFix { altitude: 410.0, ..fix.clone() });
        assert_eq!(high, Some(json!({"lat": 47.3, "lon": 8.5, "height": 410.0})));
        assert_eq!(of_fix(&NavSatFix { status: -1, ..fix.clone() }), None);
        assert_eq!(of_fix(&NavSatFix { latitude: f64::NAN, ..fix }), None);
    }
}
