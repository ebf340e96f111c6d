//! Clusters matching Gaussians: those in the same voxel or in touching voxels (26 neighbours) of a world-aligned grid
//! belong together, unless only a thin bridge joins them.
//!
//! A voxel's mass is the number of its Gaussians, each weighted by its margin over the threshold. Voxels join from
//! the heaviest to the lightest, each to its heaviest neighbour. A voxel that touches two groups joins them if its
//! mass is at least a twentieth of the lesser group's peak (clustering by prominence: Chazal et al. 2013,
//! "Persistence-based clustering in Riemannian manifolds"). A string of floaters therefore joins no two things, dense
//! or sparse.

use glam::{DVec3, I64Vec3};
use rayon::prelude::*;
use slag_api::objects::{Alignment, OrientedBox};
use slag_common::frames::Aabb;
use slag_common::shard::ShardView;
use slag_math::union_find::UnionFind;

use super::oriented::{Extent, TRIMMED, box_around};
use crate::score::{Budget, Run};

/// Bits of a voxel coordinate; three fill a `u64` key.
const AXIS_BITS: u32 = 21;
/// Least mass of a voxel that joins two groups, as a share of the lesser group's heaviest voxel. Things fill voxels
/// with tens of Gaussians, floaters with one or two.
const BRIDGE_SHARE: f64 = 0.05;
/// Weight of a Gaussian that just reaches the threshold; the best one weighs 1.
const LEAST_WEIGHT: f64 = 0.1;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grouping {
    /// Edge of the voxels, world units, positive. Doubled until the extent of the matches fits the grid.
    pub voxel: f64,
    /// Clusters with fewer members are dropped.
    pub min_count: u64,
    /// Score at or above which Gaussians match.
    pub threshold: f32,
    pub alignment: Alignment,
    pub with_members: bool,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Cluster {
    /// Cell and index of its first member: its id within a generation.
    pub first: (u32, u32),
    pub n_gaussians: u64,
    /// Mean of the members' scores.
    pub score: f32,
    pub best_score: f32,
    pub extent: Extent,
    /// Box along its own axes, those of the members inside the extent's box.
    pub oriented_box: OrientedBox,
    /// Members in storage order; empty unless asked for.
    pub members: Vec<Run>,
}

impl Cluster {
    pub fn public_id(&self) -> String {
        format!("{}-{}", self.first.0, self.first.1)
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct Clusters {
    /// Clusters with enough members, by first member, ascending.
    pub clusters: Vec<Cluster>,
    /// Clusters with too few members.
    pub n_small: u64,
    pub n_gaussians_in_small: u64,
    /// Edge of the voxels: as requested, or doubled until 21 bits could number them along each axis.
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

struct Grid {
    inverse_voxel: f64,
    base: I64Vec3,
}

impl Grid {
    fn new(reach: Aabb, voxel: &mut f64) -> Self {
        loop {
            let inverse_voxel = 1.0 / *voxel;
            let (low, high) = ((reach.min * inverse_voxel).floor(), (reach.max * inverse_voxel).floor());
            // One voxel stays free on either side, so that a step to a neighbour never carries.
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

/// Rounds down; the coordinates fit. (Without SSE 4.1 the standard rounding is a function call.)
fn floor(point: DVec3) -> I64Vec3 {
    let truncated = point.as_i64vec3();
    let is_below = |axis: usize| i64::from(point[axis] < truncated[axis] as f64);
    truncated - I64Vec3::new(is_below(0), is_below(1), is_below(2))
}

/// Returns the key differences to the 13 neighbours with greater keys.
fn forward_neighbours() -> impl Iterator<Item = u64> {
    let steps = || -1i64..=1;
    let all = steps().flat_map(move |x| steps().flat_map(move |y| steps().map(move |z| (x, y, z))));
    all.map(|(x, y, z)| (x << (2 * AXIS_BITS)) + (y << AXIS_BITS) + z).filter(|d| *d > 0).map(|d| d as u64)
}

/// Bytes of a voxel during joining: key, mass, rank, order, group, and range of its spans.
const VOXEL_BYTES: usize = 48;
/// Bytes of a member while its cluster is described: its point and a coordinate along an axis.
const MEMBER_BYTES: usize = size_of::<DVec3>() + size_of::<f64>();

/// Clusters the members of disjoint runs. Check the budget afterwards: if it is spent, the result is invalid.
pub fn cluster(shards: &[ShardView<'_>], runs: &[Run], grouping: &Grouping, budget: &Budget) -> Clusters {
    let Grouping { mut voxel, min_count, threshold, .. } = *grouping;
    let mut result = Clusters { clusters: Vec::new(), n_small: 0, n_gaussians_in_small: 0, voxel };
    let mut reach = Aabb::EMPTY;
    for runs_of_shard in runs.chunk_by(|a, b| a.shard == b.shard) {
        reach = reach.union(shards[runs_of_shard[0].shard as usize].position_box());
    }
    if runs.is_empty() {
        return result;
    }
    let grid = Grid::new(reach, &mut voxel);
    result.voxel = voxel;

    let mut spans: Vec<Span> =
        runs.par_chunks(256)
            .enumerate()
            .map(|(chunk, runs)| {
                if budget.goes_on() { spans_of(shards, runs, chunk * 256, &grid, budget) } else { Vec::new() }
            })
            .flatten_iter()
            .collect();
    spans.par_sort_unstable();
    let voxels: Vec<&[Span]> = spans.chunk_by(|a, b| a.voxel_key == b.voxel_key).collect();
    if !budget.take(voxels.len() * VOXEL_BYTES) {
        return result;
    }
    let weight = weight_of_score(runs, threshold);
    let mass = |spans: &&[Span]| -> f64 {
        spans.iter().map(|s| weight(runs[s.run as usize].score) * f64::from(s.end - s.start)).sum()
    };
    let Some(roots) = connect(&voxels, &voxels.iter().map(mass).collect::<Vec<_>>(), budget) else {
        return result;
    };
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
    // Twice: found and ranked.
    budget.take(large.len() * 2 * size_of::<Cluster>());
    result.clusters = large
        .into_par_iter()
        .filter(|group| budget.goes_on() && budget.take(count(group) as usize * MEMBER_BYTES))
        .map(|group| {
            let spans = group.iter().flat_map(|voxel| voxels[*voxel as usize]).copied().collect();
            summarise(shards, runs, spans, grouping)
        })
        .collect();
    result.clusters.sort_unstable_by_key(|cluster| cluster.first);
    result
}

fn spans_of(
    shards: &[ShardView<'_>],
    runs: &[Run],
    first_run: usize,
    grid: &Grid,
    budget: &Budget,
) -> Vec<Span> {
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
    // Twice: in this chunk and in the full list.
    budget.take(2 * size_of_val(&spans[..]));
    spans
}

/// Returns the weight of a score: from a tenth at the threshold to 1 at the best score.
fn weight_of_score(runs: &[Run], threshold: f32) -> impl Fn(f32) -> f64 {
    let best = runs.iter().fold(threshold, |best, run| best.max(run.score));
    let range = f64::from(best) - f64::from(threshold);
    move |score| match range > 0.0 {
        true => ((f64::from(score) - f64::from(threshold)) / range).clamp(LEAST_WEIGHT, 1.0),
        false => 1.0,
    }
}

/// Returns the group of each voxel (by key, ascending); `None` if the budget is spent. `masses`: `[voxels]`.
fn connect(voxels: &[&[Span]], masses: &[f64], budget: &Budget) -> Option<Vec<u32>> {
    // From here on voxels are ranked, heaviest first; a group's root is its heaviest voxel.
    let mut by_rank: Vec<u32> = (0..voxels.len() as u32).collect();
    let mass = |voxel: u32| masses[voxel as usize];
    by_rank.par_sort_unstable_by(|a, b| mass(*b).total_cmp(&mass(*a)).then(a.cmp(b)));
    let mut rank_of = vec![0u32; voxels.len()];
    by_rank.iter().zip(0..).for_each(|(voxel, rank)| rank_of[*voxel as usize] = rank);

    // Joints are processed by their lighter end, then by their heavier one.
    let mut joints: Vec<(u32, u32)> = Vec::new();
    let keys: Vec<u64> = voxels.iter().map(|spans| spans[0].voxel_key).collect();
    for difference in forward_neighbours() {
        let n_before = joints.len();
        // Keys and wanted neighbours both ascend: one pass finds them all.
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
                let (a, b) = (rank_of[at], rank_of[other]);
                joints.push((a.max(b), a.min(b)));
            }
        }
        if !budget.take((joints.len() - n_before) * size_of::<(u32, u32)>()) {
            return None;
        }
    }
    joints.par_sort_unstable();
    let mut groups = UnionFind::new(voxels.len());
    let mass = |rank: u32| masses[by_rank[rank as usize] as usize];
    for (lighter, heavier) in joints {
        let (a, b) = (groups.root(lighter), groups.root(heavier));
        let lesser = a.max(b);
        if mass(lighter) >= BRIDGE_SHARE * mass(lesser) {
            groups.attach(lesser, a.min(b));
        }
    }
    Some(rank_of.into_iter().map(|rank| groups.root(rank)).collect())
}

/// Returns the Gaussians of spans (in storage order) as runs; neighbouring spans of a run are joined.
fn members(runs: &[Run], spans: &[Span]) -> Vec<Run> {
    let mut members: Vec<Run> = Vec::new();
    let mut last_run = None;
    for span in spans {
        match members.last_mut() {
            Some(last) if last_run == Some(span.run) && last.end == span.start => last.end = span.end,
            _ => members.push(Run { start: span.start, end: span.end, ..runs[span.run as usize] }),
        }
        last_run = Some(span.run);
    }
    members
}

fn summarise(shards: &[ShardView<'_>], runs: &[Run], mut spans: Vec<Span>, grouping: &Grouping) -> Cluster {
    // In storage order, so that sums do not depend on the voxels.
    spans.sort_unstable_by_key(|span| (span.run, span.start));
    let mut points: Vec<DVec3> = Vec::new();
    let (mut score_sum, mut best_score, mut first) = (0.0, f32::NEG_INFINITY, (u32::MAX, u32::MAX));
    for span in &spans {
        let run = &runs[span.run as usize];
        let shard = &shards[run.shard as usize];
        points.extend((span.start..span.end).map(|index| shard.position_in_world(index as usize)));
        score_sum += f64::from(run.score) * f64::from(span.end - span.start);
        best_score = best_score.max(run.score);
        first = first.min((shard.header.cell_id, span.start));
    }
    let extent = Extent::of(&points);
    let inside = |point: &DVec3| extent.box_in_world.contains(*point);
    Cluster {
        first,
        n_gaussians: points.len() as u64,
        score: (score_sum / points.len() as f64) as f32,
        best_score,
        extent,
        oriented_box: box_around(&points, inside, grouping.alignment, TRIMMED),
        members: if grouping.with_members { members(runs, &spans) } else { Vec::new() },
    }
}

#[cfg(test)]
mod tests;
