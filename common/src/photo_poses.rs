//! Where a scene's photos were taken, so that a page can draw their cameras: poses, not pictures. The byte table is in
//! `docs/formats.md`.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use crate::View;
use crate::container::{ContainerError, Layout};
use crate::objects::MAX_PHOTO_BYTES;

/// Ids of the sections.
pub mod section {
    /// `[n]` [`super::PhotoPose`].
    pub const POSES: u32 = 60;
    /// UTF-8 without control characters: the names, one after the other.
    pub const NAMES: u32 = 61;
}

/// Largest difference of a rotation's length from 1: rounding to f32, with room.
const MAX_LENGTH_ERROR: f32 = 1e-3;

/// A photo's camera.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct PhotoPose {
    /// The camera, world frame, less the shard's origin.
    pub offset: [f32; 3],
    /// World from camera (x right, y down, z forward), a unit quaternion.
    pub rotation_xyzw: [f32; 4],
    /// Focal length, the mean of both axes.
    pub focal_px: f32,
    /// Width.
    pub width_px: u32,
    /// Height.
    pub height_px: u32,
    /// End of its name in the names; they follow one another.
    pub name_end: u32,
}

/// The photos of a shard.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotoPoses<'a> {
    poses: &'a [PhotoPose],
    names: &'a str,
}

impl<'a> PhotoPoses<'a> {
    /// Returns each photo with its name.
    pub fn iter(&self) -> impl Iterator<Item = (&'a PhotoPose, &'a str)> + use<'a> {
        let (poses, names) = (self.poses, self.names);
        let starts = std::iter::once(0).chain(poses.iter().map(|pose| pose.name_end as usize));
        poses.iter().zip(starts).map(move |(pose, start)| (pose, &names[start..pose.name_end as usize]))
    }

    /// Returns the sections to write.
    pub(crate) fn sections(&self) -> [(u32, &'a [u8]); 2] {
        [(section::POSES, bytemuck::cast_slice(self.poses)), (section::NAMES, self.names.as_bytes())]
    }
}

/// The photos of a shard, to be written.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BuiltPhotoPoses {
    poses: Vec<PhotoPose>,
    names: String,
}

impl BuiltPhotoPoses {
    /// Adds a photo to those of a shard with this origin. A name that readers would refuse is replaced by none: it is for
    /// people alone.
    pub fn push(&mut self, origin: DVec3, view: &View) {
        let world_from_camera = view.camera_from_world.inverse();
        let rotation = glam::DQuat::from_mat3(&world_from_camera.matrix3).normalize().as_quat();
        let is_name = view.name.len() <= MAX_PHOTO_BYTES && !view.name.chars().any(char::is_control);
        self.names.push_str(if is_name { &view.name } else { "" });
        self.poses.push(PhotoPose {
            offset: (world_from_camera.translation - origin).as_vec3().to_array(),
            rotation_xyzw: rotation.to_array(),
            focal_px: ((view.intrinsics.focal_x_px + view.intrinsics.focal_y_px) / 2.0) as f32,
            width_px: view.intrinsics.width_px,
            height_px: view.intrinsics.height_px,
            name_end: self.names.len() as u32,
        });
    }

    /// Returns the columns; `None` without photos, whose shard has no sections of them.
    pub fn view(&self) -> Option<PhotoPoses<'_>> {
        (!self.poses.is_empty()).then_some(PhotoPoses { poses: &self.poses, names: &self.names })
    }
}

/// Where the columns of a shard's checked photos lie.
#[derive(Clone, Debug)]
pub(crate) struct PhotoPosesLayout {
    poses: Range<usize>,
    names: Range<usize>,
}

impl PhotoPosesLayout {
    /// Checks the photos; returns `None` if the shard has none.
    pub(crate) fn check(bytes: &[u8], layout: &Layout) -> Result<Option<Self>, ContainerError> {
        let Some(at) = layout.find(section::POSES) else { return Ok(None) };
        let n_bytes = layout.find(section::NAMES).map_or(0, |names| names.len());
        let poses =
            layout.column::<PhotoPose>(section::POSES, "photo poses", at.len() / size_of::<PhotoPose>())?;
        let names = layout.column::<u8>(section::NAMES, "names of the photos", n_bytes)?;
        let damaged =
            |offset: usize, what: String| ContainerError::Damaged { offset_bytes: offset as u64, what };
        let text = std::str::from_utf8(&bytes[names.clone()]).ok();
        let Some(text) = text.filter(|text| !text.chars().any(char::is_control)) else {
            let what = "the names of the photos are not UTF-8 without control characters".into();
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
        Ok(Some(Self { poses, names }))
    }

    /// Returns the columns of the bytes that were checked.
    pub(crate) fn view<'a>(&self, bytes: &'a [u8]) -> PhotoPoses<'a> {
        let names = std::str::from_utf8(&bytes[self.names.clone()]).unwrap_or_default();
        PhotoPoses { poses: bytemuck::cast_slice(&bytes[self.poses.clone()]), names }
    }
}

/// Returns the fault of a photo whose name begins at `start`, if it has one.
fn fault(pose: &PhotoPose, start: usize, names: &str) -> Option<&'static str> {
    let length = pose.rotation_xyzw.iter().map(|c| c * c).sum::<f32>().sqrt();
    let name = names.get(start..pose.name_end as usize);
    match () {
        () if !pose.offset.iter().all(|c| c.is_finite()) => Some("its position is not finite"),
        // A NaN is in no range.
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
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use glam::{DAffine3, DQuat};

    use super::*;
    use crate::container::{self, AlignedBytes};
    use crate::{Distortion, Intrinsics};

    const MAGIC: [u8; 8] = *b"PHOTOSOF";

    /// A photo from (1, 2, 3) along the world's x: its right is -y, its down is -z.
    fn photo(name: &str) -> View {
        let forward_is_x = DQuat::from_rotation_z(-FRAC_PI_2) * DQuat::from_rotation_x(-FRAC_PI_2);
        let world_from_camera = DAffine3::from_rotation_translation(forward_is_x, DVec3::new(1.0, 2.0, 3.0));
        let intrinsics = Intrinsics {
            width_px: 640,
            height_px: 480,
            focal_x_px: 500.0,
            focal_y_px: 502.0,
            centre_x_px: 320.0,
            centre_y_px: 240.0,
            distortion: Distortion::None,
        };
        let camera_from_world = world_from_camera.inverse();
        View { name: name.into(), image_path: name.into(), intrinsics, camera_from_world }
    }

    fn built() -> BuiltPhotoPoses {
        let mut built = BuiltPhotoPoses::default();
        for name in ["a/1.jpg", "bad\nname", "Büro.jpg"] {
            built.push(DVec3::new(1e6, 2.0, 0.5), &photo(name));
        }
        built
    }

    fn checked(built: &BuiltPhotoPoses) -> Result<AlignedBytes, ContainerError> {
        let mut bytes = Vec::new();
        container::write(&mut bytes, MAGIC, 1, &built.view().expect("photos").sections()).expect("memory");
        let bytes = AlignedBytes::copy_of(&bytes);
        let layout = Layout::check(&bytes, MAGIC, 1)?;
        PhotoPosesLayout::check(&bytes, &layout).map(|_| bytes)
    }

    #[test]
    fn photos_come_back_by_hand() {
        let bytes = checked(&built()).expect("sound");
        let layout = Layout::check(&bytes, MAGIC, 1).expect("sound");
        let photos = PhotoPosesLayout::check(&bytes, &layout).expect("sound").expect("there");
        let photos: Vec<_> = photos.view(&bytes).iter().collect();
        assert_eq!(photos.iter().map(|(_, name)| *name).collect::<Vec<_>>(), ["a/1.jpg", "", "Büro.jpg"]);
        let (pose, _) = photos[2];
        assert_eq!((pose.offset, pose.focal_px), ([1.0 - 1e6, 0.0, 2.5], 501.0));
        assert_eq!((pose.width_px, pose.height_px), (640, 480));
        let rotation = DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5);
        let found = glam::Quat::from_array(pose.rotation_xyzw).as_dquat();
        assert!(found.dot(rotation).abs() > 1.0 - 1e-6, "{found}");
        assert_eq!(BuiltPhotoPoses::default().view(), None);
    }

    #[test]
    fn faults_are_refused_by_name() {
        let refused = |edit: fn(&mut BuiltPhotoPoses)| {
            let mut built = built();
            edit(&mut built);
            checked(&built).expect_err("must be refused").to_string()
        };
        assert!(refused(|b| b.poses[1].offset[2] = f32::NAN).contains("photo 1: its position"));
        assert!(refused(|b| b.poses[0].rotation_xyzw[3] = f32::NAN).contains("photo 0: its rotation"));
        assert!(refused(|b| b.poses[0].rotation_xyzw = [0.0; 4]).contains("length 1"));
        assert!(refused(|b| b.poses[0].focal_px = 0.0).contains("focal"));
        assert!(refused(|b| b.poses[2].height_px = 0).contains("no pixels"));
        // Back, within a letter, beyond the end, and short of it.
        assert!(refused(|b| b.poses[1].name_end = 3).contains("outside the names"));
        assert!(refused(|b| b.poses[1].name_end = 9).contains("outside the names"));
        assert!(refused(|b| b.poses[2].name_end = 99).contains("outside the names"));
        assert!(refused(|b| b.poses[2].name_end = 15).contains("end at 15 of 16 bytes"));
        assert!(refused(|b| b.names.replace_range(0..1, "\n")).contains("control characters"));
    }
}
