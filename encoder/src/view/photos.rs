//! The photos: poses and pictures.

use glam::{DQuat, DVec3, Vec3};
use slag_common::View;
use slag_view::Photo;

/// Describes photos, in the order of the views.
pub(super) fn describe(views: &[View]) -> Vec<Photo> {
    views.iter().map(photo).collect()
}

fn photo(view: &View) -> Photo {
    let world_from_camera = view.camera_from_world.inverse();
    let rotation = DQuat::from_mat3(&world_from_camera.matrix3).as_quat();
    Photo {
        name: view.name.clone(),
        position_m: world_from_camera.translation,
        rotation_xyzw: rotation.to_array(),
        width_px: view.intrinsics.width_px,
        height_px: view.intrinsics.height_px,
        focal_px: ((view.intrinsics.focal_x_px + view.intrinsics.focal_y_px) / 2.0) as f32,
        has_picture: view.image_path.is_file(),
    }
}

/// Returns the direction that is up in most photos: the mean of the cameras' upward axes; nothing if these cancel
/// out.
pub(crate) fn up_of(views: &[View]) -> Option<Vec3> {
    let up = |view: &View| view.camera_from_world.inverse().transform_vector3(DVec3::NEG_Y).normalize();
    let sum: DVec3 = views.iter().map(up).sum();
    (sum.length() > 0.2 * views.len() as f64).then(|| sum.normalize().as_vec3())
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DMat3};

    use super::*;

    /// A camera at (1, 2, 3) that looks along the world's y, with the world's z upward.
    fn level() -> View {
        let world_from_camera = DAffine3 {
            matrix3: DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y),
            translation: DVec3::new(1.0, 2.0, 3.0),
        };
        View {
            name: "a.jpg".into(),
            image_path: "none".into(),
            intrinsics: crate::raster::pinhole([64, 48], 60.0),
            camera_from_world: world_from_camera.inverse(),
        }
    }

    #[test]
    fn poses_are_those_of_the_cameras() {
        let [photo] = &describe(&[level()])[..] else { panic!("one") };
        assert!((photo.position_m - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-9 && !photo.has_picture);
        let forward = glam::Quat::from_array(photo.rotation_xyzw) * Vec3::Z;
        assert!((forward - Vec3::Y).length() < 1e-6, "{forward}");
        assert!((up_of(&[level()]).expect("up") - Vec3::Z).length() < 1e-6);
        assert_eq!(up_of(&[]), None);
    }
}
