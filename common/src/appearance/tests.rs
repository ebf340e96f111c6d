use glam::{DQuat, DVec3};
use slag_math::random::Random;

use super::*;

/// The renderer's decoder, in float64: the inverse map, then axis and angle.
fn decoded([u, v, angle]: [u8; 3]) -> DQuat {
    let [u, v] = [u, v].map(|c| f64::from(c) / 127.5 - 1.0);
    let z = 1.0 - u.abs() - v.abs();
    let fold = (-z).max(0.0);
    let moved = |c: f64| if c >= 0.0 { c - fold } else { c + fold };
    let axis = DVec3::new(moved(u), moved(v), z).normalize();
    DQuat::from_axis_angle(axis, f64::from(angle) / 255.0 * std::f64::consts::PI)
}

#[test]
fn rotations_come_back_within_the_stated_error() {
    let mut random = Random::new(20);
    let mut worst = 0.0f64;
    for _ in 0..20_000 {
        let [w, x, y, z] = random.unit_vector(4)[..] else { unreachable!("four components") };
        let expected = DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into()).normalize();
        worst = worst.max(expected.angle_between(decoded(rotation_code([w, x, y, z]))).to_degrees());
    }
    assert!((0.5..1.9).contains(&worst), "{worst}");
    assert!(decoded(rotation_code([-1.0, 0.0, 0.0, 0.0])).angle_between(DQuat::IDENTITY) < 1e-6);
}

#[test]
fn sizes_come_back_within_the_stated_error() {
    for step in 0..2000 {
        let size = (-11.9f32 + step as f32 * 0.0104).exp();
        let code = f32::from(size_code(size));
        let back = ((code - 1.0) * 21.0 / 254.0 - 12.0).exp();
        assert!((back / size - 1.0).abs() < 0.043, "{size}: {back}");
    }
    let extremes = [0.0, -1.0, f32::NAN, f32::MIN_POSITIVE, f32::MAX, f32::INFINITY];
    assert_eq!(extremes.map(size_code), [0, 0, 0, 1, 255, 255]);
}

#[test]
fn columns_follow_the_indices() {
    let scene = Gaussians {
        scales: vec![[1.0; 3], [0.1; 3]],
        opacities: vec![0.0, 0.6],
        sh_dc: vec![[0.0; 3], [9.0, -9.0, 0.0]],
        ..Gaussians::balls(vec![DVec3::ZERO; 2], 1.0)
    };
    let columns = AppearanceColumns::of(&scene, &[1, 0]);
    assert_eq!(columns.view().colours, [[255, 0, 128, 153], [128, 128, 128, 0]]);
    assert!(columns.view().sizes[0] < columns.view().sizes[1]);
}
