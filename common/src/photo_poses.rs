//! Poses of a scene's photos, so that a page can draw their cameras. Byte table: `docs/formats.md`.

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use crate::View;
use crate::container::{ContainerError, Layout, damaged};
use crate::objects::MAX_PHOTO_BYTES;

pub mod section {
    /// `[n]` [`super::PhotoPose`].
    pub const POSES: u32 = 60;
    /// UTF-8 without control characters: the names, one after the other.
    pub const NAMES: u32 = 61;
}

/// Largest deviation of a rotation's length from 1: f32 rounding with a margin.
const MAX_LENGTH_ERROR: f32 = 1e-3;

const LARGEST: f64 = f32::MAX as f64;

#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct PhotoPose {
    /// Position of the camera in the world frame, minus the shard's origin.
    pub offset: [f32; 3],
    /// World from camera (x right, y down, z forward), a unit quaternion.
    pub rotation_xyzw: [f32; 4],
    /// Focal length, the mean of both axes.
    pub focal_px: f32,
    pub width_px: u32,
    pub height_px: u32,
    /// End of its name in the concatenated names.
    pub name_end: u32,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotoPoses<'a> {
    poses: &'a [PhotoPose],
    names: &'a str,
}

impl<'a> PhotoPoses<'a> {
    /// Returns the photos in a shard's checked bytes.
    pub(crate) fn of(bytes: &'a [u8], layout: &Layout) -> Option<Self> {
        layout.find(section::POSES).map(|poses| Self {
            poses: bytemuck::cast_slice(&bytes[poses]),
            names: std::str::from_utf8(layout.slice(bytes, section::NAMES)).unwrap_or_default(),
        })
    }

    pub fn iter(&self) -> impl Iterator<Item = (&'a PhotoPose, &'a str)> + use<'a> {
        let (poses, names) = (self.poses, self.names);
        let starts = std::iter::once(0).chain(poses.iter().map(|pose| pose.name_end as usize));
        poses.iter().zip(starts).map(move |(pose, start)| (pose, &names[start..pose.name_end as usize]))
    }

    pub(crate) fn sections(&self) -> [(u32, &'a [u8]); 2] {
        [(section::POSES, bytemuck::cast_slice(self.poses)), (section::NAMES, self.names.as_bytes())]
    }
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct BuiltPhotoPoses {
    poses: Vec<PhotoPose>,
    names: String,
}

impl BuiltPhotoPoses {
    /// Adds a photo to a shard with this origin. A name that readers would refuse is dropped: names are only shown.
    pub fn push(&mut self, origin: DVec3, view: &View) {
        let world_from_camera = view.camera_from_world.inverse();
        let rotation = glam::DQuat::from_mat3(&world_from_camera.matrix3).normalize().as_quat();
        let is_name = view.name.len() <= MAX_PHOTO_BYTES && !view.name.chars().any(char::is_control);
        self.names.push_str(if is_name { &view.name } else { "" });
        // Saturates: readers would refuse the whole shard for an infinite offset.
        let offset =
            (world_from_camera.translation - origin).clamp(DVec3::splat(-LARGEST), DVec3::splat(LARGEST));
        let focal_px = view.intrinsics.focal_x_px / 2.0 + view.intrinsics.focal_y_px / 2.0;
        self.poses.push(PhotoPose {
            offset: offset.as_vec3().to_array(),
            rotation_xyzw: rotation.to_array(),
            focal_px: focal_px.clamp(f64::from(f32::MIN_POSITIVE), LARGEST) as f32,
            width_px: view.intrinsics.width_px,
            height_px: view.intrinsics.height_px,
            name_end: self.names.len() as u32,
        });
    }

    /// Returns the columns; `None` without photos, because the shard then has no sections for them.
    pub fn view(&self) -> Option<PhotoPoses<'_>> {
        (!self.poses.is_empty()).then_some(PhotoPoses { poses: &self.poses, names: &self.names })
    }
}

/// Checks the photos of a shard, if it has any.
pub(crate) fn check(bytes: &[u8], layout: &Layout) -> Result<(), ContainerError> {
    let Some(at) = layout.find(section::POSES) else { return Ok(()) };
    let n_bytes = layout.find(section::NAMES).map_or(0, |names| names.len());
    let poses =
        layout.column::<PhotoPose>(section::POSES, "photo poses", at.len() / size_of::<PhotoPose>())?;
    let names = layout.column::<u8>(section::NAMES, "names of the photos", n_bytes)?;
    let text = std::str::from_utf8(&bytes[names.clone()]).ok();
    let Some(text) = text.filter(|text| !text.chars().any(char::is_control)) else {
        let what = "the names of the photos are not UTF-8 without control characters";
        return Err(damaged(names.start, what));
    };
    let all: Vec<PhotoPose> = bytemuck::pod_collect_to_vec(&bytes[poses.clone()]);
    let mut end = 0;
    for (number, pose) in all.iter().enumerate() {
        if let Some(what) = fault(pose, end, text) {
            let offset = poses.start + number * size_of::<PhotoPose>();
            return Err(damaged(offset, format!("photo {number}: {what}")));
        }
        end = pose.name_end as usize;
    }
    if end != text.len() {
        let what = format!("the names of the photos end at {end} of {} bytes", text.len());
        return Err(damaged(names.start, what));
    }
    Ok(())
}

fn fault(pose: &PhotoPose, start: usize, names: &str) -> Option<&'static str> {
    let length = pose.rotation_xyzw.iter().map(|c| c * c).sum::<f32>().sqrt();
    let name = names.get(start..pose.name_end as usize);
    match () {
        () if !pose.offset.iter().all(|c| c.is_finite()) => Some("its position is not finite"),
        // Also true for NaN.
        () if !(1.0 - MAX_LENGTH_ERROR..=1.0 + MAX_LENGTH_ERROR).contains(&length) => {
            Some("its rotation has not length 1")
        }
        () if !(pose.focal_px > 0.0 && pose.focal_px.is_finite()) => {
            Some("its focal length is not above 0 and finite")
        }
        () if pose.width_px == 0 || pose.height_px == 0 => Some("it has no pixels"),
        () if name.is_none_or(|name| name.len() > MAX_PHOTO_BYTES) => {
            Some("its name lies outside the names, or is longer than 1024 bytes")
        }
        () => None,
    }
}

#[cfg(test)]
mod tests;
