//! Similarity transforms between world frames: scale, rotation, translation.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde::Serialize;

use crate::Gaussians;

/// A transform `p' = scale * rotation * p + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Similarity {
    /// Factor of lengths; positive.
    pub scale: f64,
    pub rotation: DQuat,
    /// Translation, units of the target frame.
    pub translation: DVec3,
}

impl Similarity {
    pub const IDENTITY: Self = Self { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    pub fn from_rotation(rotation: DQuat) -> Self {
        Self { rotation, ..Self::IDENTITY }
    }

    pub fn from_scale(scale: f64) -> Self {
        Self { scale, ..Self::IDENTITY }
    }

    /// Returns `p' = scale * rigid * p`, nerfstudio's order; `rigid` must be a rotation and a translation.
    pub fn from_rigid_then_scale(rigid: DAffine3, scale: f64) -> Self {
        let rotation = DQuat::from_mat3(&rigid.matrix3).normalize();
        Self { scale, rotation, translation: rigid.translation * scale }
    }

    pub fn transform_point(&self, point: DVec3) -> DVec3 {
        self.rotation * point * self.scale + self.translation
    }

    pub fn after(&self, first: &Self) -> Self {
        Self {
            scale: self.scale * first.scale,
            rotation: (self.rotation * first.rotation).normalize(),
            translation: self.transform_point(first.translation),
        }
    }

    pub fn inverse(&self) -> Self {
        let (scale, rotation) = (1.0 / self.scale, self.rotation.inverse());
        Self { scale, rotation, translation: -(rotation * self.translation * scale) }
    }

    /// Returns the camera of the target frame that sees what `camera_from_source` sees of the source frame. The
    /// picture is the same; depths are in units of the target frame.
    pub fn camera_from_target(&self, camera_from_source: DAffine3) -> DAffine3 {
        let inverse = self.inverse();
        DAffine3 {
            matrix3: camera_from_source.matrix3 * DMat3::from_quat(inverse.rotation),
            translation: camera_from_source.transform_point3(inverse.translation) * self.scale,
        }
    }

    pub fn is_unrotated(&self) -> bool {
        self.rotation.angle_between(DQuat::IDENTITY) < 1e-4
    }

    /// Transforms Gaussians; drops harmonics above degree 0, which belong to the source frame's axes.
    pub fn transform_gaussians(&self, gaussians: &mut Gaussians) {
        for mean in &mut gaussians.means_in_world {
            *mean = self.transform_point(*mean);
        }
        for wxyz in &mut gaussians.rotations_wxyz {
            let [w, x, y, z] = wxyz.map(f64::from);
            let turned = self.rotation * DQuat::from_xyzw(x, y, z, w);
            *wxyz = [turned.w, turned.x, turned.y, turned.z].map(|v| v as f32);
        }
        for scales in &mut gaussians.scales {
            *scales = scales.map(|s| (f64::from(s) * self.scale) as f32);
        }
        gaussians.sh_rest = Vec::new();
        gaussians.sh_degree = 0;
    }
}

#[cfg(test)]
mod tests;
