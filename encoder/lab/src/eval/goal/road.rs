//! The whole road: a photo that no map has seen, where it was taken, a word, a place to stand in the frame of the
//! robot's odometry. Judged at the place where that leads.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::Result;
use glam::{DAffine3, DQuat, DVec3};
use serde::Serialize;
use serde_json::Value;
use slag_common::{View, poses};

use super::truth::{MIN_SHOWN, SENSOR_HEIGHT_M, Truth, goal_request};
use crate::generate::compose::Layout;
use crate::generate::grammar::NOUNS;
use crate::programs::Service;

/// Where the scene truly lies in the frame of the odometry (REP-105), which the robot does not know.
const TURNED_RAD: f64 = 0.7;
const MOVED_M: DVec3 = DVec3::new(5.0, -3.0, 0.5);

/// Photos, and runs from each to each kind of things that the robot truly reaches.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(super) struct Road {
    pub(super) n_photos: usize,
    pub(super) n_located: usize,
    pub(super) n_runs: usize,
    /// Those that end where the true surfaces show such a thing.
    pub(super) n_shown: usize,
    /// Those that end where they do not.
    pub(super) n_hidden: usize,
}

impl Road {
    /// Goes from each photo of `test/` in a scene's folder.
    pub(super) fn add(
        &mut self,
        scene: &Path,
        layout: &Layout,
        truth: &Truth<'_>,
        service: &Service,
    ) -> Result<()> {
        let things = || (0..layout.placed.len()).filter(|at| !layout.placed[*at].shell);
        let noun = |at: usize| NOUNS[layout.placed[at].noun].name.as_str();
        let reachable: BTreeSet<_> = things().filter(|at| truth.is_reachable(*at)).map(noun).collect();
        let odom_from_scene =
            DAffine3::from_rotation_translation(DQuat::from_rotation_z(TURNED_RAD), MOVED_M);
        for photo in poses::read(&scene.join("test/transforms.json"), None)?.views {
            self.n_photos += 1;
            let Some(found) = located(service, &photo)? else { continue };
            self.n_located += 1;
            // Odometry gives the camera in its own frame, the photo the camera in the scene.
            let odom_from_camera = odom_from_scene * photo.camera_from_world.inverse();
            let odom_from_scene_as_found = odom_from_camera * found.inverse();
            for word in &reachable {
                self.n_runs += 1;
                let what = format!("text={}", word.replace(' ', "%20"));
                let reply = service.get(&goal_request(&what, found.translation))?;
                let Some(goal) = reply["goals"].get(0) else { continue };
                let goal_in_scene: DVec3 = serde_json::from_value(goal["position_in_world"].clone())?;
                let goal_in_odom = odom_from_scene_as_found.transform_point3(goal_in_scene);
                let sensor = odom_from_scene.inverse().transform_point3(goal_in_odom).with_z(SENSOR_HEIGHT_M);
                let is_shown = things()
                    .filter(|thing| noun(*thing) == *word)
                    .any(|thing| truth.shown(thing, sensor) >= MIN_SHOWN);
                if is_shown { self.n_shown += 1 } else { self.n_hidden += 1 }
            }
        }
        Ok(())
    }
}

/// Pose of a photo's camera in the scene, as the robot finds it.
fn located(service: &Service, photo: &View) -> Result<Option<DAffine3>> {
    let path = format!("/v1/locate?focal_px={}", photo.intrinsics.focal_x_px);
    let found: Value = service.post_image(&path, &fs_err::read(&photo.image_path)?)?;
    if found["state"] != "found" {
        return Ok(None);
    }
    let rotation: DQuat = serde_json::from_value(found["optical_rotation_xyzw"].clone())?;
    let at: DVec3 = serde_json::from_value(found["position_in_world"].clone())?;
    Ok(Some(DAffine3::from_rotation_translation(rotation, at)))
}
