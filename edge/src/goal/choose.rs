//! Candidates around a thing, their costs, and the best of them.

use glam::DVec3;
use rayon::prelude::*;
use slag_api::goal::{Goal, NoGoal};
use slag_math::distance_transform::{FAR, squared_distances};

use super::ground::Floor;
use super::paths::Paths;
use super::request::GoalRequest;
use super::sight;
use super::space::Window;
use super::surroundings::Surroundings;

/// Sample points on a thing's surface: bits of a `u128`.
const SAMPLES: usize = 128;
/// Only the cheapest candidate of each square with this edge is examined, metres.
const SQUARE_M: f64 = 0.2;
/// Most candidates examined: half of them the cheapest, half spread over the others.
const MAX_CANDIDATES: usize = 256;
/// Most candidates of any square examined if none of those sees the thing, spread over all.
const MAX_MORE: usize = 2048;
/// Least distance between two poses of a reply, metres.
const APART_M: f64 = 0.5;
/// Clearance beyond the robot's radius above which more adds nothing, metres.
const COMFORT_M: f64 = 0.3;
/// Cost of a pose without any comfort over one with all, in metres of path.
const CLEARANCE_WEIGHT_M: f64 = 2.0;
/// Least visible share of a pose, relative to that of the pose that sees most.
const SHARE_OF_BEST: f64 = 0.5;
/// Cost of a pose that sees nothing over one that sees all, in metres of path.
const SIGHT_WEIGHT_M: f64 = 4.0;

#[derive(Clone, Copy)]
struct Candidate {
    cell: usize,
    path_m: f64,
    /// Path and clearance; visibility is not known yet.
    cost_m: f64,
}

/// Returns the best poses near the thing with a surface at `points`, or why there is none.
pub fn choose(
    around: &Surroundings<'_>,
    paths: &Paths,
    request: &GoalRequest,
    points: &[DVec3],
) -> Result<Vec<Goal>, NoGoal> {
    let window = &around.space.window;
    let near = cells_near(window, points, request.stand.reach_m + window.voxel * 0.5f64.sqrt());
    let candidate = |cell: &usize| {
        let path_m = paths.to(*cell)? * window.voxel;
        let spare_m = (around.clearance_m(*cell) - request.robot.radius_m).clamp(0.0, COMFORT_M);
        let cost_m = path_m + CLEARANCE_WEIGHT_M * (1.0 - spare_m / COMFORT_M);
        Some(Candidate { cell: *cell, path_m, cost_m })
    };
    let reached: Vec<Candidate> = near.iter().filter_map(candidate).collect();
    if reached.is_empty() {
        return Err(missing(around, &near));
    }
    let target = Target::new(around, request, points);
    let looked_at = |candidates: Vec<Candidate>| -> Vec<Look> {
        let look = |of| around.budget.goes_on().then(|| look(around, request, &target, of)).flatten();
        candidates.into_par_iter().filter_map(look).collect()
    };
    let mut looks = looked_at(sifted(window, reached.clone()));
    // Over the edge of a table, the thing on it is often seen only from a strip that is narrower than a square.
    if looks.iter().all(|look| look.visible_share < request.stand.min_visible) {
        let step = reached.len().div_ceil(MAX_MORE);
        looks = looked_at(reached.into_iter().step_by(step).collect());
    }
    if looks.is_empty() {
        return Err(NoGoal::Unreachable);
    }
    let best_share = looks.iter().map(|look| look.visible_share).fold(0.0, f64::max);
    let least = request.stand.min_visible.max(SHARE_OF_BEST * best_share);
    let mut seeing: Vec<Look> = looks.into_iter().filter(|look| look.visible_share >= least).collect();
    if seeing.is_empty() {
        return Err(NoGoal::NotVisible);
    }
    seeing.sort_by(|a, b| a.cost_m.total_cmp(&b.cost_m).then_with(|| place(a).total_cmp(&place(b))));
    let mut best: Vec<Look> = Vec::new();
    for look in seeing {
        let is_apart = |other: &Look| other.position_in_world.distance(look.position_in_world) >= APART_M;
        if best.len() < request.stand.limit && best.iter().all(is_apart) {
            best.push(look);
        }
    }
    Ok(best.iter().map(|look| goal(around, &target, look)).collect())
}

fn place(look: &Look) -> f64 {
    look.position_in_world.x + 1e3 * look.position_in_world.y
}

/// Returns exactly the cells with a point within a horizontal distance, in the order of their numbers.
fn cells_near(window: &Window, points: &[DVec3], distance: f64) -> Vec<usize> {
    let voxels: Vec<[i64; 2]> =
        points.iter().map(|point| window.voxel_of(*point)).map(|[x, y, _]| [x.into(), y.into()]).collect();
    let reach = (distance / window.voxel).ceil() as i64;
    let n = window.cells().map(|n| n as i64);
    let bound = |axis: usize| {
        let of_axis = voxels.iter().map(|voxel| voxel[axis]);
        let (low, high) = (of_axis.clone().min().unwrap_or(0), of_axis.max().unwrap_or(-1));
        // Points outside the window count, too: their own cells are within the margin if they matter.
        (low - reach).max(-reach)..(high + reach + 1).min(n[axis] + reach)
    };
    let (xs, ys) = (bound(0), bound(1));
    if xs.is_empty() || ys.is_empty() {
        return Vec::new();
    }
    let width = (ys.end - ys.start) as usize;
    let mut has_point = vec![false; width * (xs.end - xs.start) as usize];
    for [x, y] in voxels.into_iter().filter(|[x, y]| xs.contains(x) && ys.contains(y)) {
        has_point[(x - xs.start) as usize * width + (y - ys.start) as usize] = true;
    }
    let limit = (distance / window.voxel).powi(2);
    let squared = squared_distances(&has_point, width);
    let near = squared.iter().enumerate().filter(|(_, d2)| **d2 != FAR && f64::from(**d2) <= limit);
    let cell = near.map(|(at, _)| [xs.start + (at / width) as i64, ys.start + (at % width) as i64]);
    cell.filter(|[x, y]| (0..n[0]).contains(x) && (0..n[1]).contains(y))
        .map(|[x, y]| (x * n[1] + y) as usize)
        .collect()
}

/// Returns the cheapest candidate of each square, and of those at most [`MAX_CANDIDATES`].
fn sifted(window: &Window, candidates: Vec<Candidate>) -> Vec<Candidate> {
    let square = (SQUARE_M / window.voxel).round().max(1.0) as usize;
    let n_y = window.cells()[1];
    let key = |of: &Candidate| (of.cell / n_y / square, of.cell % n_y / square);
    let mut sorted = candidates;
    sorted.sort_by(|a, b| key(a).cmp(&key(b)).then(a.cost_m.total_cmp(&b.cost_m)).then(a.cell.cmp(&b.cell)));
    sorted.dedup_by_key(|of| key(of));
    sorted.sort_by(|a, b| a.cost_m.total_cmp(&b.cost_m).then(a.cell.cmp(&b.cell)));
    if sorted.len() <= MAX_CANDIDATES {
        return sorted;
    }
    let rest = sorted.split_off(MAX_CANDIDATES / 2);
    let step = rest.len().div_ceil(MAX_CANDIDATES / 2);
    sorted.extend(rest.into_iter().step_by(step));
    sorted
}

struct Target<'a> {
    points: &'a [DVec3],
    samples: Vec<DVec3>,
    thing: sight::Thing<'a>,
}

impl<'a> Target<'a> {
    fn new(around: &'a Surroundings<'_>, request: &GoalRequest, points: &'a [DVec3]) -> Self {
        let step = points.len().div_ceil(SAMPLES).max(1);
        let samples = points.iter().copied().step_by(step).collect();
        Self { points, samples, thing: sight::Thing::new(&around.space, points, request.stand.reach_m) }
    }

    fn distance(points: &[DVec3], [x, y]: [f64; 2]) -> f64 {
        // Eight independent minima, as each waits for its predecessor.
        let mut least = [f64::INFINITY; 8];
        for points in points.chunks(least.len()) {
            for (least, p) in least.iter_mut().zip(points) {
                *least = least.min((p.x - x).powi(2) + (p.y - y).powi(2));
            }
        }
        least.into_iter().fold(f64::INFINITY, f64::min).sqrt()
    }
}

struct Look {
    of: Candidate,
    position_in_world: DVec3,
    sensor_in_world: DVec3,
    /// By sample: whether it is seen.
    seen: u128,
    visible_share: f64,
    cost_m: f64,
}

/// Looks at the thing from a candidate; `None` if the thing is out of reach after all.
fn look(
    around: &Surroundings<'_>,
    request: &GoalRequest,
    target: &Target<'_>,
    of: Candidate,
) -> Option<Look> {
    let [x, y] = around.space.window.centre_of(of.cell);
    let mut pieces = target.points.chunks(64);
    if !pieces.any(|points| Target::distance(points, [x, y]) <= request.stand.reach_m) {
        return None;
    }
    let position_in_world = DVec3::new(x, y, around.floor_height(of.cell)?);
    let sensor_in_world = position_in_world + DVec3::Z * request.robot.sensor_height_m;
    let voxel = around.space.window.voxel_of(sensor_in_world);
    let mut seen = 0u128;
    for (bit, point) in (0..).zip(&target.samples) {
        seen |= u128::from(sight::sees(&target.thing, sensor_in_world, voxel, *point)) << bit;
    }
    let visible_share = f64::from(seen.count_ones()) / target.samples.len() as f64;
    let cost_m = of.cost_m + SIGHT_WEIGHT_M * (1.0 - visible_share);
    Some(Look { of, position_in_world, sensor_in_world, seen, visible_share, cost_m })
}

fn goal(around: &Surroundings<'_>, target: &Target<'_>, look: &Look) -> Goal {
    let Look { of, position_in_world, sensor_in_world, seen, visible_share, cost_m } = *look;
    let [x, y] = [position_in_world.x, position_in_world.y];
    let points = (0..).zip(&target.samples).filter(|(bit, _)| seen >> bit & 1 != 0).map(|(_, point)| point);
    let middle = points.sum::<DVec3>() / f64::from(seen.count_ones());
    let yaw_rad = (middle.y - y).atan2(middle.x - x);
    Goal {
        position_in_world,
        geographic: None,
        yaw_rad,
        orientation_xyzw: [0.0, 0.0, (yaw_rad / 2.0).sin(), (yaw_rad / 2.0).cos()],
        sensor_in_world,
        clearance_m: around.clearance_m(of.cell),
        visible_share,
        path_m: of.path_m,
        distance_m: Target::distance(target.points, [x, y]),
        cost_m,
    }
}

/// Returns why no path leads to any of the cells near a thing.
fn missing(around: &Surroundings<'_>, near: &[usize]) -> NoGoal {
    let n_unknown = near.iter().filter(|cell| around.ground.floors[**cell] == Floor::Unknown).count();
    if near.is_empty() || 2 * n_unknown > near.len() { NoGoal::UnknownGround } else { NoGoal::Unreachable }
}
