use std::f64::consts::FRAC_PI_2;

use glam::{DAffine3, DQuat};

use super::*;
use crate::container::{self, AlignedBytes};
use crate::{Intrinsics, pinhole};

const MAGIC: [u8; 8] = *b"PHOTOSOF";

/// A photo from (1, 2, 3) along the world's x: its right is -y, its down is -z.
fn photo(name: &str) -> View {
    let forward_is_x = DQuat::from_rotation_z(-FRAC_PI_2) * DQuat::from_rotation_x(-FRAC_PI_2);
    let world_from_camera = DAffine3::from_rotation_translation(forward_is_x, DVec3::new(1.0, 2.0, 3.0));
    let intrinsics = Intrinsics { focal_y_px: 502.0, ..pinhole([640, 480], 500.0) };
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
    check(&bytes, &layout).map(|()| bytes)
}

#[test]
fn photos_come_back_by_hand() {
    let bytes = checked(&built()).expect("sound");
    let layout = Layout::check(&bytes, MAGIC, 1).expect("sound");
    let photos: Vec<_> = PhotoPoses::of(&bytes, &layout).expect("there").iter().collect();
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

#[test]
fn the_largest_numbers_saturate() {
    let mut built = BuiltPhotoPoses::default();
    for size in [1e39, 1e300, f64::MAX] {
        let mut view = photo("a.jpg");
        view.intrinsics.focal_x_px = size;
        view.camera_from_world.translation = DVec3::new(size, 0.0, 0.0);
        built.push(DVec3::splat(-1e38), &view);
        view.intrinsics.focal_x_px = 1e-300;
        view.intrinsics.focal_y_px = 1e-300;
        built.push(DVec3::ZERO, &view);
    }
    checked(&built).expect("sound");
}
