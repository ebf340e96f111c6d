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
    let other = Similarity { scale: 2.5, rotation: DQuat::from_rotation_y(-0.4), translation: DVec3::ONE };
    let matrix = |s: &Similarity| {
        DAffine3::from_scale_rotation_translation(DVec3::splat(s.scale), s.rotation, s.translation)
    };
    let (a, b) = (example(), other);
    let close = |x: DAffine3, y: DAffine3| {
        let holds = x.to_cols_array().iter().zip(y.to_cols_array()).all(|(x, y)| (x - y).abs() < 1e-12);
        assert!(holds, "{x} {y}");
    };
    close(matrix(&a.after(&b)), matrix(&a) * matrix(&b));
    close(matrix(&a.inverse()), matrix(&a).inverse());
}

/// By the definition: a point and its image lie on the same pixel ray, and depths scale.
#[test]
fn the_transformed_camera_sees_the_same() {
    let s = example();
    let camera = DAffine3::from_rotation_translation(DQuat::from_rotation_x(0.3), DVec3::new(0.1, -2.0, 4.0));
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
