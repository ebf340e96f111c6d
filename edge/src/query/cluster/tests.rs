use proptest::prelude::*;

use super::*;
use crate::testing::{Member, TestShard};

const GROUPING: Grouping = Grouping {
    voxel: 0.25,
    min_count: 10,
    threshold: 0.0,
    alignment: Alignment::Gravity,
    with_members: false,
};

/// Clusters points on a lattice of 5 cm; each list has its own score.
fn clusters_of(lists: &[(f32, Vec<[u16; 3]>)]) -> Vec<Cluster> {
    let centroids = lists.iter().map(|(_, points)| {
        points.iter().map(|at| Member { steps: *at, embedding: vec![1.0, 0.0] }).collect()
    });
    let shard = TestShard { step: DVec3::splat(0.05), ..TestShard::new(centroids.collect()) }.build(false);
    let view = shard.view();
    let run = |(centroid, (score, _)): (usize, &(f32, _))| {
        let members = view.members(centroid);
        Run { shard: 0, start: members.start as u32, end: members.end as u32, score: *score }
    };
    let runs: Vec<Run> = lists.iter().enumerate().map(run).collect();
    cluster(&[view], &runs, &Grouping { threshold: 0.3, ..GROUPING }, &Budget::default()).clusters
}

/// Lattice points of a box between two corners, excluding the upper one.
fn block(from: [u16; 3], to: [u16; 3]) -> Vec<[u16; 3]> {
    let along = |axis: usize| from[axis]..to[axis];
    let planes = along(0).flat_map(|x| along(1).map(move |y| (x, y)));
    planes.flat_map(|(x, y)| along(2).map(move |z| [x, y, z])).collect()
}

/// One point every 25 cm between x = 10 and x = 40 steps: a string of floaters.
fn string() -> Vec<[u16; 3]> {
    (10..40).step_by(5).map(|x| [x, 4, 4]).collect()
}

#[test]
fn a_string_of_floaters_joins_nothing() {
    let (one, other) = (block([0, 0, 0], [10, 10, 10]), block([40, 0, 0], [50, 10, 10]));
    let solid = [one.clone(), block([10, 3, 3], [40, 6, 6]), other.clone()].concat();
    assert_eq!(clusters_of(&[(0.5, solid)]).len(), 1, "a rod of 20 points a voxel holds");
    let found = clusters_of(&[(0.5, [one.clone(), string(), other.clone()].concat())]);
    let counts: Vec<u64> = found.iter().map(|c| c.n_gaussians).collect();
    assert_eq!((counts.len(), counts.iter().sum::<u64>()), (2, 2006), "{counts:?}");
    // The string belongs to one of the two, but lies outside its box.
    for (cluster, x) in found.iter().zip([0.225, 2.225]) {
        let holds = (cluster.extent.position_in_world - DVec3::new(x, 0.225, 0.225)).length() < 0.05;
        assert!(holds, "{cluster:?}");
        assert!((cluster.oriented_box.size - DVec3::splat(0.45)).abs().max_element() < 0.06, "{cluster:?}");
    }
}

/// A bridge just above the threshold weighs a tenth of one that scores as high as its ends.
#[test]
fn scores_count_for_bridges() {
    let ends = [block([0, 0, 0], [10, 10, 10]), block([40, 0, 0], [50, 10, 10])].concat();
    let bridge = block([10, 3, 3], [40, 6, 4]);
    assert_eq!(clusters_of(&[(0.5, ends.clone()), (0.5, bridge.clone())]).len(), 1);
    assert_eq!(clusters_of(&[(0.5, ends), (0.301, bridge)]).len(), 2);
}

/// In a sparse cloud one Gaussian per voxel is enough.
#[test]
fn sparse_things_hold_together() {
    let ground: Vec<[u16; 3]> = block([0, 0, 0], [10, 10, 1]).into_iter().map(|p| p.map(|v| v * 5)).collect();
    assert_eq!(clusters_of(&[(0.5, ground)]).len(), 1);
    assert_eq!(clusters_of(&[(0.5, [string(), string()].concat())]).len(), 1);
}

/// Oracle: voxels as coordinates and lists, heaviest first; each joins its touching voxels, the heaviest neighbour's
/// group first. `weights`: of the points.
fn brute_force(points: &[DVec3], weights: &[f64], voxel: f64) -> Vec<Vec<usize>> {
    let mut voxels: Vec<(I64Vec3, f64, Vec<usize>)> = Vec::new();
    for (at, point) in points.iter().enumerate() {
        let place = (*point / voxel).floor().as_i64vec3();
        let of_place = voxels.iter_mut().find(|v| v.0 == place);
        match of_place {
            Some((_, mass, members)) => (*mass, _) = (*mass + weights[at], members.push(at)),
            None => voxels.push((place, weights[at], vec![at])),
        }
    }
    voxels.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.to_array().cmp(&b.0.to_array())));
    // Each group's voxels, heaviest first.
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for at in 0..voxels.len() {
        groups.push(vec![at]);
        for heavier in (0..at).filter(|h| (voxels[*h].0 - voxels[at].0).abs().max_element() == 1) {
            let group_of = |v: usize| groups.iter().position(|g| g.contains(&v)).expect("each has one");
            let (own, other) = (group_of(at), group_of(heavier));
            let peak = |group: usize| voxels[groups[group][0]].1;
            if own != other && voxels[at].1 / peak(own).min(peak(other)) >= 0.05 {
                let joined = groups.remove(own.max(other));
                groups[own.min(other)].extend(joined);
                groups[own.min(other)].sort_unstable();
            }
        }
    }
    let members = |group: Vec<usize>| group.into_iter().flat_map(|v| voxels[v].2.clone()).collect();
    groups.into_iter().map(members).collect()
}

/// Two lumps and scattered points: heavy voxels, light ones, and bridges between them.
fn lumpy() -> impl Strategy<Value = [u16; 3]> {
    let lump = |x: std::ops::Range<u16>| (x, 0u16..3, 0u16..3).prop_map(|(x, y, z)| [x, y, z]);
    prop_oneof![4 => lump(0..3), 4 => lump(11..14), 1 => lump(0..24), 2 => prop::array::uniform3(0u16..24)]
}

proptest! {
    /// Oracle: groups by definition, over all pairs of voxels; sorted columns for the boxes.
    #[test]
    fn equals_brute_force_groups(
        steps in prop::collection::vec(lumpy(), 1..150), split in 0usize..150,
        levels in prop::collection::vec(0i32..4, 150),
        min_count in 1u64..6, x_shift in -3i32..3,
    ) {
        let split = split.min(steps.len());
        // A power of two, so that the oracle's division and the grid's product agree on borders.
        let (voxel, step) = (2.0, 0.75);
        let origin = DVec3::new(f64::from(x_shift) * 7.3, -20.1, 3.0);
        let shard = |cell_id: u32, steps: &[[u16; 3]]| {
            let members = steps.iter().map(|at| Member { steps: *at, embedding: vec![1.0, 0.0] }).collect();
            TestShard { cell_id, origin, step: DVec3::splat(step), ..TestShard::new(vec![members]) }.build(false)
        };
        let built: Vec<_> = [(9, &steps[..split]), (4, &steps[split..])]
            .into_iter().filter(|(_, steps)| !steps.is_empty()).map(|(id, steps)| shard(id, steps)).collect();
        let views: Vec<_> = built.iter().map(|b| b.view()).collect();
        let mut points = Vec::new();
        let mut names = Vec::new();
        let mut runs = Vec::new();
        // Weights of 1/8 to 1 have exact sums; the first is the best, so weights equal scores.
        let score_of = |point: usize| if point == 0 { 1.0 } else { (-levels[point] as f32).exp2() };
        for (at, view) in views.iter().enumerate() {
            let n = view.header.n_gaussians;
            runs.extend((0..n).map(|i| Run { shard: at as u32, start: i, end: i + 1, score: score_of(points.len() + i as usize) }));
            points.extend((0..n as usize).map(|i| view.position_in_world(i)));
            names.extend((0..n).map(|i| (view.header.cell_id, i)));
        }
        let found = cluster(&views, &runs, &Grouping { voxel, min_count, ..GROUPING }, &Budget::default());
        let weights: Vec<f64> = (0..points.len()).map(|point| f64::from(score_of(point))).collect();
        let (large, small): (Vec<_>, Vec<_>) =
            brute_force(&points, &weights, voxel).into_iter().partition(|m| m.len() as u64 >= min_count);
        prop_assert_eq!(found.n_small as usize, small.len());
        prop_assert_eq!(found.n_gaussians_in_small as usize, small.iter().map(Vec::len).sum::<usize>());
        prop_assert_eq!(found.clusters.len(), large.len());
        for members in large {
            let first = members.iter().map(|m| names[*m]).min().expect("has members");
            let cluster = found.clusters.iter().find(|c| c.first == first).expect("same first member");
            prop_assert_eq!(cluster.n_gaussians as usize, members.len());
            let mean = members.iter().map(|m| weights[*m]).sum::<f64>() / members.len() as f64;
            prop_assert!((f64::from(cluster.score) - mean).abs() < 1e-6);
            let best = members.iter().map(|m| weights[*m]).fold(0.0, f64::max);
            prop_assert_eq!(f64::from(cluster.best_score), best);
            let cut = members.len().saturating_sub(1) / 50;
            let mut inside = members.clone();
            for axis in [0, 1, 2] {
                let mut column: Vec<f64> = members.iter().map(|m| points[*m][axis]).collect();
                column.sort_by(f64::total_cmp);
                let (low, high) = (column[cut], column[column.len() - 1 - cut]);
                prop_assert_eq!((cluster.extent.box_in_world.min[axis], cluster.extent.box_in_world.max[axis]), (low, high));
                inside.retain(|m| (low..=high).contains(&points[*m][axis]));
            }
            let mean = inside.iter().map(|m| points[*m]).sum::<DVec3>() / inside.len() as f64;
            prop_assert!((cluster.extent.position_in_world - mean).length() < 1e-9);
        }
    }
}

/// A voxel far too small for the extent is doubled without overflow.
#[test]
fn hopeless_voxels_grow() {
    let members = vec![
        Member { steps: [0; 3], embedding: vec![1.0, 0.0] },
        Member { steps: [65535; 3], embedding: vec![1.0, 0.0] },
    ];
    let shard = TestShard { step: DVec3::splat(1e4), ..TestShard::new(vec![members]) }.build(false);
    let runs = [Run { shard: 0, start: 0, end: 2, score: 0.5 }];
    let found = |voxel: f64| {
        let grouping = Grouping { voxel, min_count: 1, ..GROUPING };
        cluster(&[shard.view()], &runs, &grouping, &Budget::default())
    };
    for voxel in [f64::MIN_POSITIVE, 1e-9, 0.25] {
        let found = found(voxel);
        assert_eq!(found.clusters.len(), 2);
        assert!(found.voxel >= 65535e4 / f64::from(1 << AXIS_BITS), "{}", found.voxel);
    }
    assert_eq!(found(1e300).clusters.len(), 1);
}
