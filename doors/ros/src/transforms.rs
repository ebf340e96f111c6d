//! The tree of frames from `/tf` and `/tf_static`.

use std::collections::HashMap;

use crate::geometry::Rigid;
use crate::messages::TransformStamped;

/// Most frames kept: a robot has a few dozen, and messages are foreign.
const MAX_FRAMES: usize = 1024;

/// The newest transform of each frame to its parent.
#[derive(Debug, Default)]
pub struct Transforms(HashMap<String, (String, Rigid)>);

impl Transforms {
    /// Stores a transform. Invalid ones are dropped, as are new frames beyond the limit.
    pub fn insert(&mut self, transform: TransformStamped) {
        let Some(parent_from_child) = Rigid::new(transform.translation, transform.rotation) else { return };
        let child = plain(&transform.child_frame_id).to_owned();
        if self.0.len() < MAX_FRAMES || self.0.contains_key(&child) {
            self.0.insert(child, (plain(&transform.header.frame_id).to_owned(), parent_from_child));
        }
    }

    /// Returns the motion from a frame to another; `None` if unconnected. They are joined at their first common
    /// ancestor, as a static transform may make the scene a sibling of the robot's map.
    pub fn target_from(&self, target: &str, frame: &str) -> Option<Rigid> {
        let of_target: HashMap<&str, Rigid> = self.ancestors(target).collect();
        self.ancestors(frame)
            .find_map(|(name, from_frame)| Some(of_target.get(name)?.inverse().after(from_frame)))
    }

    /// Returns a frame and its ancestors, each with the motion from the frame. In a cycle each is visited once.
    fn ancestors<'a>(&'a self, frame: &'a str) -> impl Iterator<Item = (&'a str, Rigid)> {
        let first = Some((plain(frame), Rigid::IDENTITY));
        std::iter::successors(first, |(at, at_from_frame)| {
            let (parent, parent_from_at) = self.0.get(*at)?;
            Some((parent.as_str(), parent_from_at.after(*at_from_frame)))
        })
        .take(self.0.len() + 1)
    }
}

/// Strips the leading slash of ROS 1, which some nodes still write.
fn plain(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Quaternion;
    use crate::messages::Header;
    use ros2_client::builtin_interfaces::Time;

    fn told(parent: &str, child: &str, translation: [f64; 3], [z, w]: [f64; 2]) -> TransformStamped {
        TransformStamped {
            header: Header { stamp: Time::ZERO, frame_id: parent.to_owned() },
            child_frame_id: child.to_owned(),
            translation: translation.into(),
            rotation: Quaternion { x: 0.0, y: 0.0, z, w },
        }
    }

    #[test]
    fn chains_are_followed_to_the_scene() {
        let mut frames = Transforms::default();
        let half = std::f64::consts::FRAC_1_SQRT_2;
        // Odometry is turned by 90 degrees: its x is the map's y.
        frames.insert(told("map", "odom", [10.0, 0.0, 0.0], [half, half]));
        frames.insert(told("/odom", "base_link", [2.0, 0.5, 0.0], [0.0, 1.0]));
        let [x, y, z] = frames.target_from("map", "base_link").expect("connected").origin();
        assert!((x - 9.5).abs() < 1e-12 && (y - 2.0).abs() < 1e-12 && z == 0.0, "{x} {y} {z}");
        assert!(frames.target_from("map", "camera").is_none());
        let back = frames.target_from("base_link", "map").expect("connected").apply([9.5, 2.0, 0.0]);
        assert!(back.iter().all(|c| c.abs() < 1e-12), "{back:?}");
        // As in docs/ros.md: a static transform from the map to the scene makes them siblings.
        frames.insert(told("map", "scene", [1.0, 2.0, 0.0], [0.0, 1.0]));
        let [x, y, z] = frames.target_from("scene", "base_link").expect("connected").origin();
        assert!((x - 8.5).abs() < 1e-12 && y.abs() < 1e-12 && z == 0.0, "{x} {y} {z}");
    }

    #[test]
    fn circles_and_false_transforms_end() {
        let mut frames = Transforms::default();
        frames.insert(told("a", "b", [0.0; 3], [0.0, 1.0]));
        frames.insert(told("b", "a", [0.0; 3], [0.0, 1.0]));
        assert!(frames.target_from("map", "a").is_none());
        frames.insert(told("map", "c", [f64::NAN, 0.0, 0.0], [0.0, 1.0]));
        frames.insert(told("map", "d", [0.0; 3], [0.0, 0.0]));
        assert!(frames.target_from("map", "c").is_none() && frames.target_from("map", "d").is_none());
        for i in 0..3000 {
            frames.insert(told("map", &format!("f{i}"), [0.0; 3], [0.0, 1.0]));
        }
        assert_eq!(frames.0.len(), MAX_FRAMES);
    }
}
