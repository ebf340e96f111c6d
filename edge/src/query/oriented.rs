//! Oriented boxes of points: principal axes, or upright where the world has a known up.

use glam::{DMat3, DQuat, DVec2, DVec3};
use slag_api::objects::{Alignment, OrientedBox};
use slag_common::frames::Aabb;
use slag_math::eigen::eigen_symmetric;
use slag_math::stats::trimmed_range;

/// Returns the box of a set of points: axes from the points inside `core`, extents from the `trimmed` to the `1 -
/// trimmed` quantile of all points.
///
/// `core` excludes floaters from the axes: their leverage grows with the square of their distance.
pub fn box_around(
    points: &[DVec3],
    core: impl Fn(&DVec3) -> bool,
    alignment: Alignment,
    trimmed: f64,
) -> OrientedBox {
    let inside: Vec<DVec3> = points.iter().copied().filter(core).collect();
    let axes = axes_of(&inside, alignment);
    let Aabb { min, max } = trimmed_box(points, trimmed, |axis, point| axes.col(axis).dot(point));
    let (axes, min, max) = longest_first(axes, min, max, alignment);
    OrientedBox {
        centre_in_world: axes * ((min + max) * 0.5),
        size: max - min,
        rotation_world_from_box: DQuat::from_mat3(&axes).normalize(),
        alignment,
    }
}

fn axes_of(points: &[DVec3], alignment: Alignment) -> DMat3 {
    let n = points.len().max(1) as f64;
    let mean = points.iter().sum::<DVec3>() / n;
    let mut covariance = DMat3::ZERO;
    for offset in points.iter().map(|point| *point - mean) {
        covariance += DMat3::from_cols(offset * offset.x, offset * offset.y, offset * offset.z);
    }
    match alignment {
        Alignment::Principal => {
            let (_, vectors) = eigen_symmetric(covariance.to_cols_array().to_vec(), 3);
            DMat3::from_cols_slice(&vectors)
        }
        Alignment::Gravity => {
            // The 2x2 block's principal axis, in closed form.
            let (xx, xy, yy) = (covariance.x_axis.x, covariance.x_axis.y, covariance.y_axis.y);
            let x = DVec2::from_angle(0.5 * (2.0 * xy).atan2(xx - yy));
            DMat3::from_cols(x.extend(0.0), x.perp().extend(0.0), DVec3::Z)
        }
    }
}

/// Makes the box unique: longest axis first (an upright box keeps z), largest components positive, right-handed.
fn longest_first(axes: DMat3, min: DVec3, max: DVec3, alignment: Alignment) -> (DMat3, DVec3, DVec3) {
    let size = max - min;
    let mut order = [0, 1, 2];
    let n_free = if alignment == Alignment::Gravity { 2 } else { 3 };
    order[..n_free].sort_by(|a, b| size[*b].total_cmp(&size[*a]));
    let mut out = (DMat3::IDENTITY, DVec3::ZERO, DVec3::ZERO);
    for (to, from) in order.into_iter().enumerate() {
        let axis = axes.col(from);
        let largest = (0..3).fold(0, |best, i| if axis[i].abs() > axis[best].abs() { i } else { best });
        // An upright box's third axis points up already; its second is flipped to match below.
        let sign = if axis[largest] < 0.0 { -1.0 } else { 1.0 };
        *out.0.col_mut(to) = axis * sign;
        (out.1[to], out.2[to]) = if sign < 0.0 { (-max[from], -min[from]) } else { (min[from], max[from]) };
    }
    if out.0.determinant() < 0.0 {
        // The third may have to point up.
        *out.0.col_mut(1) *= -1.0;
        (out.1.y, out.2.y) = (-out.2.y, -out.1.y);
    }
    out
}

/// Share of points outside a box at either end of each axis, so that a few floaters do not inflate it.
pub const TRIMMED: f64 = 0.02;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    pub position_in_world: DVec3,
    /// 2nd to 98th percentile along each axis (all points if fewer than 51).
    pub box_in_world: Aabb,
}

impl Extent {
    /// At least one point is required.
    pub fn of(points: &[DVec3]) -> Self {
        let box_in_world = trimmed_box(points, TRIMMED, |axis, point| point[axis]);
        let inside = points.iter().filter(|point| box_in_world.contains(**point));
        let (sum, n) = inside.fold((DVec3::ZERO, 0u64), |(sum, n), point| (sum + *point, n + 1));
        // Trimming excludes at most 4 % per axis, so some point is inside along all three.
        Self { position_in_world: sum / n as f64, box_in_world }
    }
}

/// Returns the `trimmed` to `1 - trimmed` quantiles of the points' coordinates along each axis.
fn trimmed_box(points: &[DVec3], trimmed: f64, coordinate: impl Fn(usize, DVec3) -> f64) -> Aabb {
    let (mut min, mut max) = (DVec3::ZERO, DVec3::ZERO);
    let mut values = Vec::with_capacity(points.len());
    for axis in 0..3 {
        values.clear();
        values.extend(points.iter().map(|point| coordinate(axis, *point)));
        (min[axis], max[axis]) = trimmed_range(&mut values, trimmed).unwrap_or_default();
    }
    Aabb { min, max }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use slag_math::random::Random;

    use super::*;

    /// Points on a lattice that fills a box of edges `size`, rotated by `rotation` around `centre`.
    fn lattice(size: DVec3, rotation: DQuat, centre: DVec3) -> Vec<DVec3> {
        let steps = |edge: f64| (0..12).map(move |i| (f64::from(i) / 11.0 - 0.5) * edge);
        let (x, y, z) = (steps(size.x), steps(size.y), steps(size.z));
        let points = x.flat_map(move |x| {
            let z = z.clone();
            y.clone().flat_map(move |y| z.clone().map(move |z| DVec3::new(x, y, z)))
        });
        points.map(|point| centre + rotation * point).collect()
    }

    fn quat() -> impl Strategy<Value = DQuat> {
        prop::array::uniform4(-1.0f64..1.0)
            .prop_filter("has a direction", |v| v.iter().map(|v| v * v).sum::<f64>() > 0.1)
            .prop_map(|v| DQuat::from_array(v).normalize())
    }

    /// The largest distance between a corner of `found` and the nearest corner of the original box.
    fn corner_error(found: &OrientedBox, size: DVec3, rotation: DQuat, centre: DVec3) -> f64 {
        let corners = |centre: DVec3, size: DVec3, rotation: DQuat| {
            let sign = |bit: usize, i: usize| if i >> bit & 1 == 1 { 0.5 } else { -0.5 };
            (0..8).map(move |i| centre + rotation * (size * DVec3::new(sign(0, i), sign(1, i), sign(2, i))))
        };
        let ours = corners(found.centre_in_world, found.size, found.rotation_world_from_box);
        let nearest =
            |a: DVec3| corners(centre, size, rotation).map(|b| a.distance(b)).fold(f64::MAX, f64::min);
        ours.map(nearest).fold(0.0, f64::max)
    }

    proptest! {
        /// Oracle: the box that the points were made from.
        #[test]
        fn a_turned_box_is_found_again(
            rotation in quat(), yaw in -4.0f64..4.0, centre in prop::array::uniform3(-1e3f64..1e3),
            edges in prop::array::uniform3(0.0f64..0.2),
        ) {
            // Edges of different lengths: equal ones have no axes.
            let size = DVec3::new(2.0, 1.0, 0.5) + DVec3::from(edges);
            let centre = DVec3::from(centre);
            let points = lattice(size, rotation, centre);
            let found = box_around(&points, |_| true, Alignment::Principal, 0.0);
            prop_assert!((found.size - size).length() < 1e-6, "{found:?}");
            prop_assert!(corner_error(&found, size, rotation, centre) < 1e-6, "{found:?}");

            let upright = DQuat::from_rotation_z(yaw);
            let tall = DVec3::new(size.y, size.z, size.x);
            let points = lattice(tall, upright, centre);
            let found = box_around(&points, |_| true, Alignment::Gravity, 0.0);
            prop_assert!((found.size - tall).length() < 1e-6, "{found:?}");
            prop_assert!(corner_error(&found, tall, upright, centre) < 1e-6, "{found:?}");
            let up = found.rotation_world_from_box * DVec3::Z;
            prop_assert!((up - DVec3::Z).length() < 1e-12, "{up}");
        }

        /// Upright boxes stay upright and contain their points, whatever the points.
        #[test]
        fn every_point_is_inside_without_trimming(
            points in prop::collection::vec(prop::array::uniform3(-10.0f64..10.0), 0..40), gravity in any::<bool>(),
        ) {
            let points: Vec<DVec3> = points.into_iter().map(DVec3::from).collect();
            let alignment = if gravity { Alignment::Gravity } else { Alignment::Principal };
            let found = box_around(&points, |_| true, alignment, 0.0);
            prop_assert!(found.rotation_world_from_box.is_normalized() && found.size.is_finite());
            prop_assert!(!gravity || ((found.rotation_world_from_box * DVec3::Z) - DVec3::Z).length() < 1e-9);
            for point in &points {
                let inside = found.rotation_world_from_box.inverse() * (*point - found.centre_in_world);
                prop_assert!(inside.abs().cmple(found.size * 0.5 + 1e-9).all(), "{point} {found:?}");
            }
        }
    }

    /// One point in a hundred is a floater, up to 50 edges away.
    #[test]
    fn floaters_do_not_move_the_box() {
        let mut random = Random::new(9);
        let (size, centre) = (DVec3::new(0.8, 0.4, 1.2), DVec3::new(3.0, -2.0, 0.6));
        let rotation = DQuat::from_rotation_z(0.6);
        let mut points = lattice(size, rotation, centre);
        for _ in 0..points.len() / 100 {
            let mut far = || f64::from(random.signed()) * 40.0;
            points.push(DVec3::new(far(), far(), far()));
        }
        // The core of clusters: quantiles along the world's axes.
        let range = |axis: usize| {
            trimmed_range(&mut points.iter().map(|p| p[axis]).collect::<Vec<_>>(), 0.02).expect("has points")
        };
        let core: [(f64, f64); 3] = std::array::from_fn(range);
        let in_core = |p: &DVec3| (0..3).all(|axis| (core[axis].0..=core[axis].1).contains(&p[axis]));
        let found = box_around(&points, in_core, Alignment::Gravity, 0.02);
        // A lattice step is a tenth of an edge at most.
        assert!((found.size - size).abs().max_element() < 0.13, "{found:?}");
        let yaw = found.rotation_world_from_box.to_scaled_axis().z;
        assert!((yaw - 0.6).abs() < 0.05, "{yaw}");
        let deluded = box_around(&points, |_| true, Alignment::Gravity, 0.0);
        assert!(deluded.size.max_element() > 20.0, "the floaters were too tame: {deluded:?}");
    }
}
