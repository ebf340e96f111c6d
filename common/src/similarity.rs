//! Similarity transforms between world frames: scale, rotation, translation.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde::Serialize;

use crate::Gaussians;

/// A transform `p' = scale * rotation * p + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Similarity {
    /// Factor of lengths; positive.
    pub scale: f64,
    /// Rotation.
    pub rotation: DQuat,
    /// Translation, units of the target frame.
    pub translation: DVec3,
}

impl Similarity {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// Returns a rotation.
    pub fn from_rotation(rotation: DQuat) -> Self {
        Self { rotation, ..Self::IDENTITY }
    }

    /// Returns a change of scale.
    pub fn from_scale(scale: f64) -> Self {
        Self { scale, ..Self::IDENTITY }
    }

    /// Returns `p' = scale * rigid * p`, nerfstudio's order; `rigid` must be a rotation and a translation.
    pub fn from_rigid_then_scale(rigid: DAffine3, scale: f64) -> Self {
        let rotation = DQuat::from_mat3(&rigid.matrix3).normalize();
        Self { scale, rotation, translation: rigid.translation * scale }
    }

    /// Returns the transformed point.
    pub fn transform_point(&self, point: DVec3) -> DVec3 {
        self.rotation * point * self.scale + self.translation
    }

    /// Returns the transform that applies `first` and then this one.
    pub fn after(&self, first: &Self) -> Self {
        Self {
            scale: self.scale * first.scale,
            rotation: (self.rotation * first.rotation).normalize(),
            translation: self.transform_point(first.translation),
        }
    }

    /// Returns the inverse.
    pub fn inverse(&self) -> Self {
        let (scale, rotation) = (1.0 / self.scale, self.rotation.inverse());
        Self { scale, rotation, translation: -(rotation * self.translation * scale) }
    }

    /// Returns the camera of this transform's target frame that sees what `camera_from_source` sees of the source frame.
    ///
    /// Depths are in units of the target frame; pictures are the same.
    pub fn camera_from_target(&self, camera_from_source: DAffine3) -> DAffine3 {
        let inverse = self.inverse();
        DAffine3 {
            matrix3: camera_from_source.matrix3 * DMat3::from_quat(inverse.rotation),
            translation: camera_from_source.transform_point3(inverse.translation) * self.scale,
        }
    }

    /// Returns whether the rotation is the identity, within rounding.
    pub fn is_unrotated(&self) -> bool {
        self.rotation.angle_between(DQuat::IDENTITY) < 1e-4
    }

    /// Transforms Gaussians: means, rotations and standard deviations.
    ///
    /// Spherical harmonics above degree 0 belong to the axes of the source frame; they are dropped.
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
mod tests {
    use super::*;

    fn example() -> Similarity {
        Similarity {
            scale: 0.37,
            rotation: DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 1.1),
            translation: DVec3::new(3.0, -1.0, 0.25),
        }
    }

    /// Oracle: 4 x 4 matrices.
    #[test]
    fn composition_and_inverse_are_those_of_matrices() {
        let other =
            Similarity { scale: 2.5, rotation: DQuat::from_rotation_y(-0.4), translation: DVec3::ONE };
        let matrix = |s: &Similarity| {
            DAffine3::from_scale_rotation_translation(DVec3::splat(s.scale), s.rotation, s.translation)
        };
        let (a, b) = (example(), other);
        let close = |x: DAffine3, y: DAffine3| {
            assert!(
                x.to_cols_array().iter().zip(y.to_cols_array()).all(|(x, y)| (x - y).abs() < 1e-12),
                "{x} {y}"
            );
        };
        close(matrix(&a.after(&b)), matrix(&a) * matrix(&b));
        close(matrix(&a.inverse()), matrix(&a).inverse());
    }

    /// By the definition: a point and its image lie on the same pixel ray, and depths scale.
    #[test]
    fn the_transformed_camera_sees_the_same() {
        let s = example();
        let camera =
            DAffine3::from_rotation_translation(DQuat::from_rotation_x(0.3), DVec3::new(0.1, -2.0, 4.0));
        let moved = s.camera_from_target(camera);
        for point in [DVec3::ZERO, DVec3::new(1.0, -5.0, 2.0), DVec3::new(-3.0, 0.2, 7.0)] {
            let (before, after) =
                (camera.transform_point3(point), moved.transform_point3(s.transform_point(point)));
            assert!((after - before * s.scale).length() < 1e-12, "{before} {after}");
        }
    }

    /// Oracle: the covariance of a transformed Gaussian is `s^2 R C R^T`.
    #[test]
    fn gaussians_keep_their_shape() {
        let covariance = |g: &Gaussians| {
            let [w, x, y, z] = g.rotations_wxyz[0].map(f64::from);
            let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
            let scales = DVec3::from_array(g.scales[0].map(f64::from));
            rotation * DMat3::from_diagonal(scales * scales) * rotation.transpose()
        };
        let s = example();
        let mut gaussians = Gaussians {
            means_in_world: vec![DVec3::new(1.0, 2.0, 3.0)],
            rotations_wxyz: vec![[0.8, 0.0, 0.6, 0.0]],
            scales: vec![[0.1, 0.2, 0.4]],
            opacities: vec![0.5],
            sh_dc: vec![[0.0; 3]],
            sh_rest: vec![1.0; 9],
            sh_degree: 1,
        };
        let before = covariance(&gaussians);
        s.transform_gaussians(&mut gaussians);
        let rotation = DMat3::from_quat(s.rotation);
        let expected = rotation * before * rotation.transpose() * (s.scale * s.scale);
        let difference = (covariance(&gaussians) - expected).to_cols_array();
        assert!(difference.iter().all(|d| d.abs() < 1e-8), "{difference:?}");
        assert_eq!((gaussians.sh_rest.len(), gaussians.sh_degree), (0, 0));
        assert!(gaussians.is_usable(0));
    }
}
