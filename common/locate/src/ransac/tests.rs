//! Oracle: poselib 2.0.5 (`poselib.p3p`) on problems from `numpy.random.default_rng(47)`: a random rotation, a
//! translation of up to 3 along each axis, points at depths of 2 to 8; rays are `R X + t` normalised, centres `-R'
//! t`, rounded.

use super::*;

type Problem = ([[f64; 3]; 3], [[f64; 3]; 3], &'static [[f64; 3]]);

const PROBLEMS: [Problem; 4] = [
    (
        [
            [-0.276840665017, 0.264405014017, 0.923823162058],
            [-0.300020001117, 0.187415901073, 0.935341263366],
            [0.052059085996, 0.24892802098, 0.967121859921],
        ],
        [[0.317353, 4.025902, 2.460337], [0.235676, 5.819689, 2.313795], [-1.514521, 3.87849, 3.011696]],
        &[[-0.38025, 9.3378, 1.21592], [0.44884, -1.30001, 1.10324]],
    ),
    (
        [
            [0.233572888032, 0.332102504046, 0.913866310126],
            [0.212082841025, 0.177636914021, 0.960971381114],
            [0.04818978598, -0.164656752932, 0.985173029595],
        ],
        [[2.61858, 2.504232, -4.250017], [0.854839, 1.038985, -4.384843], [-0.966967, -0.991275, -4.769884]],
        &[[-2.38876, -3.47287, -1.14279], [-0.93586, -4.11839, -3.93961]],
    ),
    (
        [
            [0.166381921051, -0.13031296804, 0.9774127003],
            [0.414514455944, -0.013003713998, 0.909949816878],
            [0.367485307102, 0.333253917093, 0.868272063242],
        ],
        [
            [3.086163, -1.825803, -7.681535],
            [4.571884, -0.513911, -6.780603],
            [5.698406, -1.864314, -4.596608],
        ],
        &[
            [-2.24457, -0.93526, -3.35484],
            [-2.03466, -0.46506, -2.72448],
            [0.46996, 4.02915, -3.51815],
            [2.68094, -1.99093, 0.05609],
        ],
    ),
    (
        [
            [0.286977088944, 0.015834305997, 0.957806569812],
            [-0.374571048152, 0.29683088512, 0.878400794356],
            [0.114328769024, -0.035895978008, 0.99279424421],
        ],
        [
            [2.807858, -5.546218, -3.413249],
            [2.544478, -0.448231, -0.901992],
            [3.592748, -4.250668, -3.303754],
        ],
        &[
            [1.99518, -7.012, -2.84967],
            [2.25486, -0.31027, 1.72372],
            [5.21772, -4.69748, 4.41882],
            [8.86859, -4.80468, 1.31915],
        ],
    ),
];

#[test]
fn poses_are_those_of_poselib() {
    for (rays, points, expected) in PROBLEMS {
        let (rays, points) = (rays.map(DVec3::from), points.map(DVec3::from));
        let poses = p3p(rays, points);
        let mut found: Vec<DVec3> = poses.iter().map(|pose| pose.inverse().translation).collect();
        found.sort_by(|a, b| a.x.total_cmp(&b.x));
        assert_eq!(found.len(), expected.len(), "{found:?}");
        for (found, expected) in found.iter().zip(expected) {
            assert!(found.distance(DVec3::from(*expected)) < 2e-5, "{found} {expected:?}");
        }
        for (pose, (ray, point)) in
            poses.iter().flat_map(|pose| rays.iter().zip(points).map(move |p| (pose, p)))
        {
            assert!(pose.transform_point3(point).normalize().distance(*ray) < 1e-9);
            assert!((pose.matrix3.determinant() - 1.0).abs() < 1e-9);
        }
    }
}

#[test]
fn degenerate_points_have_no_pose() {
    let rays = [DVec3::Z, DVec3::new(0.6, 0.0, 0.8), DVec3::new(0.0, 0.6, 0.8)];
    let [a, b] = [DVec3::new(0.0, 0.0, 5.0), DVec3::new(1.0, 0.0, 5.0)];
    assert!(p3p(rays, [a, a, b]).is_empty());
    assert!(p3p(rays, [a, b, a + 2.0 * (b - a)]).is_empty());
    assert!(p3p(rays, [a, b, DVec3::NAN]).is_empty());
}
