//! The scene's place in odometry's frame, from single photos.

use std::collections::VecDeque;

use slag_robot::api::locate;
use slag_robot::xyz;

use crate::geometry::Rigid;
use crate::messages::CameraInfo;
use crate::transforms::Transforms;

const N_KEPT: usize = 7;
/// Photos that must agree on the robot's place, including this one.
const MIN_AGREEING: usize = 2;
/// Largest distance between the robot's places by two agreeing photos, world units and radians.
const MAX_APART: f64 = 0.5;
const MAX_TURNED: f64 = 0.087;

/// The camera's frames at the time of a photo.
#[derive(Clone, Copy, Debug)]
pub struct CameraFrames {
    pub fixed_from_optical: Rigid,
    pub optical_from_base: Rigid,
}

impl CameraFrames {
    pub fn find(frames: &Transforms, fixed: &str, optical: &str, base: &str) -> Option<Self> {
        let fixed_from_optical = frames.target_from(fixed, optical)?;
        Some(Self { fixed_from_optical, optical_from_base: frames.target_from(optical, base)? })
    }

    /// Returns the parameters of `POST /v1/locate`: odometry keeps z up, so the direction of gravity is known.
    pub fn parameters(&self, camera: &CameraInfo) -> Vec<(&'static str, String)> {
        let gravity = self.fixed_from_optical.to_child([0.0, 0.0, -1.0]);
        vec![
            ("focal_px", camera.p[0][0].to_string()),
            ("centre_px", format!("{},{}", camera.p[0][2], camera.p[1][2])),
            ("gravity", xyz(gravity)),
        ]
    }
}

/// Returns a pose as a motion; `None` if it is invalid.
pub fn scene_from_optical(pose: &locate::Pose) -> Option<Rigid> {
    Rigid::new(pose.position_in_world.into(), pose.optical_rotation_xyzw.into())
}

/// The scene's place in the fixed frame by the last photos.
#[derive(Debug, Default)]
pub struct Fixes(VecDeque<Rigid>);

impl Fixes {
    /// Adds a photo's result, and returns the newest of those that most others agree with; `None` while no two agree.
    /// A single wrong photo thus moves nothing, and a carried robot is followed once two photos agree on the new
    /// place and the old ones are forgotten. `base_in_fixed`: the robot's position.
    pub fn add(&mut self, fixed_from_scene: Rigid, base_in_fixed: [f64; 3]) -> Option<Rigid> {
        self.0.truncate(N_KEPT - 1);
        self.0.push_front(fixed_from_scene);
        let n_agreeing = |one: &Rigid| self.0.iter().filter(|of| agree(*one, **of, base_in_fixed)).count();
        // Of equal ones the last, so from the oldest to the newest.
        let (n, best) = self.0.iter().rev().map(|one| (n_agreeing(one), *one)).max_by_key(|(n, _)| *n)?;
        (n >= MIN_AGREEING).then_some(best)
    }
}

/// Returns whether two motions place the robot at the same place of the scene.
fn agree(a: Rigid, b: Rigid, base_in_fixed: [f64; 3]) -> bool {
    let [p, q] = [a, b].map(|of| of.inverse().apply(base_in_fixed));
    let apart = p.iter().zip(q).map(|(p, q)| (p - q) * (p - q)).sum::<f64>().sqrt();
    apart <= MAX_APART && a.inverse().after(b).angle() <= MAX_TURNED
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Quaternion;

    fn at(x: f64, yaw: f64) -> Rigid {
        let (sin, cos) = (yaw / 2.0).sin_cos();
        Rigid::new([x, 0.0, 0.0].into(), Quaternion { x: 0.0, y: 0.0, z: sin, w: cos }).expect("a motion")
    }

    /// By hand: the photos at 0.0 and 0.1 agree; the one 5 m away does not, nor a rotated one.
    #[test]
    fn one_wrong_photo_moves_nothing() {
        let mut fixes = Fixes::default();
        assert!(fixes.add(at(0.0, 0.0), [1.0, 0.0, 0.0]).is_none());
        for (x, yaw, expected) in [(5.0, 0.0, None), (0.1, 0.0, Some(0.1)), (5.1, 0.5, Some(0.1))] {
            let found = fixes.add(at(x, yaw), [1.0, 0.0, 0.0]).map(|found| found.origin()[0]);
            assert_eq!(found, expected, "{x} {yaw}");
        }
        // Carried elsewhere: followed once most remembered photos agree.
        let moved: Vec<f64> = (0..7)
            .filter_map(|_| fixes.add(at(9.0, 0.0), [1.0, 0.0, 0.0]))
            .map(|of| of.origin()[0])
            .collect();
        assert_eq!(moved, [0.1, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0]);
    }

    /// Seen 100 m from the scene's origin, a turn of 2 degrees is 3.5 m: such photos do not agree.
    #[test]
    fn turns_count_where_the_robot_is() {
        assert!(agree(at(0.0, 0.0), at(0.0, 0.035), [1.0, 0.0, 0.0]));
        assert!(!agree(at(0.0, 0.0), at(0.0, 0.035), [100.0, 0.0, 0.0]));
    }
}
