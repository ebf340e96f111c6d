//! Groups matching Gaussians into objects: Gaussians in the same or in touching voxels (26
//! neighbours) of a world-aligned grid belong together.

use glam::{DVec3, I64Vec3};
use rayon::prelude::*;
use slag_common::frames::Aabb;
use slag_common::shard::ShardView;

use crate::score::Run;

/// Bits of a voxel's coordinate in its key, three of which fill a `u64`.
const AXIS_BITS: u32 = 21;
/// The part of a cluster's members, from either end along each axis, that its box leaves out: a few
/// floaters must not blow it up.
const TRIMMED: f64 = 0.02;

/// Gaussians that belong together.
#[derive(Clone, Debug, PartialEq)]
pub struct Cluster {
    /// Cell and index of its first member: names it within a generation.
    pub first: (u32, u32),
    /// Members.
    pub n_gaussians: u64,
    /// Mean of the members' scores.
    pub score: f32,
    /// Best of the members' scores.
    pub best_score: f32,
    /// Mean of the members inside the box.
    pub position_in_world: DVec3,
    /// From the 2nd to the 98th percentile of the members' means along each axis (all of them where
    /// they are fewer than 51).
    pub box_in_world: Aabb,
}

/// All clusters of some matches.
#[derive(Clone, Debug, PartialEq)]
pub struct Clusters {
    /// Those with enough members, by first member, ascending.
    pub clusters: Vec<Cluster>,
    /// Clusters with too few members.
    pub n_small: u64,
    /// Gaussians in those.
    pub n_gaussians_in_small: u64,
    /// Edge of the voxels: as asked, or doubled until 21 bits could number those of one axis.
    pub voxel: f64,
}

/// Consecutive members of a run that share a voxel.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Span {
    voxel_key: u64,
    run: u32,
    start: u32,
    end: u32,
}

/// Numbers the voxels so that keys of neighbours differ by constants.
struct Grid {
    inverse_voxel: f64,
    base: I64Vec3,
}

impl Grid {
    fn new(reach: Aabb, voxel: &mut f64) -> Self {
        loop {
            let inverse_voxel = 1.0 / *voxel;
            let (low, high) = ((reach.min * inverse_voxel).floor(), (reach.max * inverse_voxel).floor());
            // One voxel is kept free on either side, so that stepping to a neighbour never carries.
            if (high - low).max_element() < f64::from((1u32 << AXIS_BITS) - 3) {
                return Self { inverse_voxel, base: low.as_i64vec3() - 1 };
            }
            *voxel *= 2.0;
        }
    }

    fn key(&self, point: DVec3) -> u64 {
        let at = floor(point * self.inverse_voxel) - self.base;
        (at.x as u64) << (2 * AXIS_BITS) | (at.y as u64) << AXIS_BITS | at.z as u64
    }
}

/// Rounds down; the coordinates fit by far. (Without SSE 4.1 the standard rounding is a call.)
fn floor(point: DVec3) -> I64Vec3 {
    let truncated = point.as_i64vec3();
    let is_below = |axis: usize| i64::from(point[axis] < truncated[axis] as f64);
    truncated - I64Vec3::new(is_below(0), is_below(1), is_below(2))
}

/// Returns the key differences to the 13 neighbours whose key is greater.
fn forward_neighbours() -> impl Iterator<Item = u64> {
    let steps = || -1i64..=1;
    let all = steps().flat_map(move |x| steps().flat_map(move |y| steps().map(move |z| (x, y, z))));
    all.map(|(x, y, z)| (x << (2 * AXIS_BITS)) + (y << AXIS_BITS) + z).filter(|d| *d > 0).map(|d| d as u64)
}

/// Groups the members of runs. `voxel`: edge length, world units, positive; it is taken as is, except
/// that it is doubled until the matches' extent fits the grid.
pub fn cluster(shards: &[ShardView<'_>], runs: &[Run], voxel: f64, min_count: u64) -> Clusters {
    let mut voxel = voxel;
    let mut result = Clusters { clusters: Vec::new(), n_small: 0, n_gaussians_in_small: 0, voxel };
    let mut reach = Aabb::EMPTY;
    for runs_of_shard in runs.chunk_by(|a, b| a.shard == b.shard) {
        let of_shard = shards[runs_of_shard[0].shard as usize].position_box();
        reach = Aabb { min: reach.min.min(of_shard.min), max: reach.max.max(of_shard.max) };
    }
    if runs.is_empty() {
        return result;
    }
    let grid = Grid::new(reach, &mut voxel);
    result.voxel = voxel;

    let mut spans: Vec<Span> = runs
        .par_chunks(256)
        .enumerate()
        .flat_map_iter(|(chunk, runs)| spans_of(shards, runs, chunk * 256, &grid))
        .collect();
    spans.par_sort_unstable();
    let voxels: Vec<&[Span]> = spans.chunk_by(|a, b| a.voxel_key == b.voxel_key).collect();
    let roots = connect(&voxels);
    let mut by_root: Vec<u32> = (0..voxels.len() as u32).collect();
    by_root.sort_by_key(|voxel| roots[*voxel as usize]);
    let groups: Vec<&[u32]> = by_root.chunk_by(|a, b| roots[*a as usize] == roots[*b as usize]).collect();

    let count = |group: &[u32]| -> u64 {
        let spans = group.iter().flat_map(|voxel| voxels[*voxel as usize]);
        spans.map(|span| u64::from(span.end - span.start)).sum()
    };
    let (large, small): (Vec<&[u32]>, Vec<&[u32]>) =
        groups.into_iter().partition(|group| count(group) >= min_count);
    result.n_small = small.len() as u64;
    result.n_gaussians_in_small = small.into_iter().map(count).sum();
    result.clusters = large
        .into_par_iter()
        .map(|group| {
            let mut spans: Vec<Span> =
                group.iter().flat_map(|voxel| voxels[*voxel as usize]).copied().collect();
            // Members in storage order, so that sums do not depend on how the world is voxelised.
            spans.sort_unstable_by_key(|span| (span.run, span.start));
            summarise(shards, runs, &spans)
        })
        .collect();
    result.clusters.sort_unstable_by_key(|cluster| cluster.first);
    result
}

fn spans_of(shards: &[ShardView<'_>], runs: &[Run], first_run: usize, grid: &Grid) -> Vec<Span> {
    let mut spans: Vec<Span> = Vec::new();
    for (at, run) in runs.iter().enumerate() {
        let shard = &shards[run.shard as usize];
        let run_at = (first_run + at) as u32;
        for index in run.start..run.end {
            let voxel_key = grid.key(shard.position_in_world(index as usize));
            match spans.last_mut() {
                Some(last) if (last.voxel_key, last.run) == (voxel_key, run_at) => last.end = index + 1,
                _ => spans.push(Span { voxel_key, run: run_at, start: index, end: index + 1 }),
            }
        }
    }
    spans
}

/// Returns for each voxel (by key, ascending) the first voxel of its connected component.
fn connect(voxels: &[&[Span]]) -> Vec<u32> {
    fn root_of(parents: &mut [u32], mut at: u32) -> u32 {
        while parents[at as usize] != at {
            parents[at as usize] = parents[parents[at as usize] as usize];
            at = parents[at as usize];
        }
        at
    }
    let keys: Vec<u64> = voxels.iter().map(|spans| spans[0].voxel_key).collect();
    let mut parents: Vec<u32> = (0..voxels.len() as u32).collect();
    for difference in forward_neighbours() {
        // Keys ascend, so the neighbours sought do too: one walk finds them all.
        let mut other = 0;
        for at in 0..keys.len() {
            let wanted = keys[at] + difference;
            while other < keys.len() && keys[other] < wanted {
                other += 1;
            }
            if other == keys.len() {
                break;
            }
            if keys[other] == wanted {
                let (a, b) = (root_of(&mut parents, at as u32), root_of(&mut parents, other as u32));
                parents[a.max(b) as usize] = a.min(b);
            }
        }
    }
    (0..voxels.len() as u32).map(|at| root_of(&mut parents, at)).collect()
}

fn summarise(shards: &[ShardView<'_>], runs: &[Run], spans: &[Span]) -> Cluster {
    let mut points: Vec<DVec3> = Vec::new();
    let (mut score_sum, mut best_score, mut first) = (0.0, f32::NEG_INFINITY, (u32::MAX, u32::MAX));
    for span in spans {
        let run = &runs[span.run as usize];
        let shard = &shards[run.shard as usize];
        points.extend((span.start..span.end).map(|index| shard.position_in_world(index as usize)));
        score_sum += f64::from(run.score) * f64::from(span.end - span.start);
        best_score = best_score.max(run.score);
        first = first.min((shard.header.cell_id, span.start));
    }
    let box_in_world = trimmed_box(&points);
    let inside = |p: &&DVec3| p.cmpge(box_in_world.min).all() && p.cmple(box_in_world.max).all();
    let (sum, n_inside) =
        points.iter().filter(inside).fold((DVec3::ZERO, 0u64), |(sum, n), point| (sum + *point, n + 1));
    Cluster {
        first,
        n_gaussians: points.len() as u64,
        score: (score_sum / points.len() as f64) as f32,
        best_score,
        // Trimming leaves out at most 4 % per axis, so some member is inside along all three.
        position_in_world: sum / n_inside as f64,
        box_in_world,
    }
}

/// Returns the box between the `TRIMMED` and `1 - TRIMMED` quantiles along each axis.
fn trimmed_box(points: &[DVec3]) -> Aabb {
    let cut = (TRIMMED * (points.len() - 1) as f64) as usize;
    let (mut min, mut max) = (DVec3::ZERO, DVec3::ZERO);
    let mut values = Vec::with_capacity(points.len());
    for axis in 0..3 {
        values.clear();
        values.extend(points.iter().map(|point| point[axis]));
        let (_, low, above) = values.select_nth_unstable_by(cut, f64::total_cmp);
        min[axis] = *low;
        // The upper quantile's place among what lies above the lower one.
        max[axis] = match above.len().checked_sub(1 + cut) {
            Some(place) => *above.select_nth_unstable_by(place, f64::total_cmp).1,
            None => min[axis],
        };
    }
    Aabb { min, max }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::testing::{Member, TestShard};

    /// Connected components the slow way: all pairs, voxels at most one apart along each axis.
    fn brute_force(points: &[DVec3], voxel: f64) -> Vec<Vec<usize>> {
        let voxel_of = |p: DVec3| (p / voxel).floor();
        let mut component: Vec<Option<usize>> = vec![None; points.len()];
        let mut components = Vec::new();
        for seed in 0..points.len() {
            if component[seed].is_some() {
                continue;
            }
            let mut members = Vec::new();
            let mut open = vec![seed];
            component[seed] = Some(components.len());
            while let Some(at) = open.pop() {
                members.push(at);
                for other in 0..points.len() {
                    let apart = (voxel_of(points[at]) - voxel_of(points[other])).abs().max_element();
                    if component[other].is_none() && apart <= 1.0 {
                        component[other] = Some(components.len());
                        open.push(other);
                    }
                }
            }
            members.sort_unstable();
            components.push(members);
        }
        components
    }

    proptest! {
        /// Oracle: all-pairs connected components, and sorted columns for the boxes.
        #[test]
        fn equals_brute_force_components(
            steps in prop::collection::vec(prop::array::uniform3(0u16..24), 1..150), split in 0usize..150,
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
            for (at, view) in views.iter().enumerate() {
                let n = view.header.n_gaussians;
                runs.extend((0..n).map(|i| Run { shard: at as u32, start: i, end: i + 1, score: (points.len() + i as usize) as f32 }));
                points.extend((0..n as usize).map(|i| view.position_in_world(i)));
                names.extend((0..n).map(|i| (view.header.cell_id, i)));
            }
            let found = cluster(&views, &runs, voxel, min_count);
            let (large, small): (Vec<_>, Vec<_>) =
                brute_force(&points, voxel).into_iter().partition(|m| m.len() as u64 >= min_count);
            prop_assert_eq!(found.n_small as usize, small.len());
            prop_assert_eq!(found.n_gaussians_in_small as usize, small.iter().map(Vec::len).sum::<usize>());
            prop_assert_eq!(found.clusters.len(), large.len());
            for members in large {
                let first = members.iter().map(|m| names[*m]).min().expect("has members");
                let cluster = found.clusters.iter().find(|c| c.first == first).expect("same first member");
                prop_assert_eq!(cluster.n_gaussians as usize, members.len());
                let mean = members.iter().map(|m| *m as f64).sum::<f64>() / members.len() as f64;
                prop_assert!((f64::from(cluster.score) - mean).abs() < 1e-4 * (1.0 + mean));
                prop_assert_eq!(cluster.best_score as usize, *members.iter().max().expect("has members"));
                let cut = members.len().saturating_sub(1) / 50;
                let mut inside = members.clone();
                for axis in [0, 1, 2] {
                    let mut column: Vec<f64> = members.iter().map(|m| points[*m][axis]).collect();
                    column.sort_by(f64::total_cmp);
                    let (low, high) = (column[cut], column[column.len() - 1 - cut]);
                    prop_assert_eq!((cluster.box_in_world.min[axis], cluster.box_in_world.max[axis]), (low, high));
                    inside.retain(|m| (low..=high).contains(&points[*m][axis]));
                }
                let mean = inside.iter().map(|m| points[*m]).sum::<DVec3>() / inside.len() as f64;
                prop_assert!((cluster.position_in_world - mean).length() < 1e-9);
            }
        }
    }

    /// A voxel far too small for the extent is doubled, and nothing overflows on the way.
    #[test]
    fn hopeless_voxels_grow() {
        let members = vec![
            Member { steps: [0; 3], embedding: vec![1.0, 0.0] },
            Member { steps: [65535; 3], embedding: vec![1.0, 0.0] },
        ];
        let shard = TestShard { step: DVec3::splat(1e4), ..TestShard::new(vec![members]) }.build(false);
        let runs = [Run { shard: 0, start: 0, end: 2, score: 0.5 }];
        for voxel in [f64::MIN_POSITIVE, 1e-9, 0.25] {
            let found = cluster(&[shard.view()], &runs, voxel, 1);
            assert_eq!(found.clusters.len(), 2);
            assert!(found.voxel >= 65535e4 / f64::from(1 << AXIS_BITS), "{}", found.voxel);
        }
        assert_eq!(cluster(&[shard.view()], &runs, 1e300, 1).clusters.len(), 1);
    }
}
