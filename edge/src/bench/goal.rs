//! Times `GET /v1/goal` in a made yard that is known everywhere: the question, the things that match, their surfaces, the ground,
//! ways, sight and the reply, from request to body, over loopback.

use std::io;
use std::path::Path;
use std::sync::{Arc, RwLock};
use std::time::Instant;

use glam::DVec3;
use serde::Serialize;
use slag_common::frames::Aabb;
use slag_common::objects::{ObjectRecord, Objects, ObjectsHeader, collect_runs, quantise_vectors};
use slag_common::occupancy::{BLOCK_EDGE, Block, BuiltOccupancy};
use slag_common::shard::{self, Additions, Positions, ScoreErrors, ShardHeader, ShardView};
use slag_common::tuf::generate_key;
use slag_math::random::Random;

use super::machine::Machine;
use super::robot::{Robot, RobotError};
use super::scene::{Cell, N_CONCEPTS, Published, concept, encoder_id};
use super::times::Percentiles;
use super::timing::quantile;

/// Height up to which places are known, metres.
const HEIGHT_M: f64 = 2.4;
/// Boxes in each 100 square metres.
const THINGS_PER_100_M2: f64 = 12.0;
/// Every so many boxes one has a fence, over which no robot sees it: a divisor of [`N_CONCEPTS`], so texts ask for one kind.
const FENCED: u64 = 8;
/// From a box to its fence, and the fence's thickness, metres.
const FENCE_M: [f64; 2] = [0.15, 0.1];
/// Between two Gaussians of a surface, metres.
const GAP_M: f64 = 0.04;
/// Beyond its quarter of the yard a shard's Gaussians may lie, metres.
const MARGIN_M: f64 = 1.0;
/// Components of an embedding.
const DIM: u32 = 512;
/// Untimed searches before the timed ones.
const N_WARM_UP: u64 = 5;

/// Times of the search.
#[derive(Clone, Debug, Serialize)]
pub struct GoalTiming {
    /// How far around the robot ground is looked at.
    pub range_m: f64,
    /// Edge of a voxel.
    pub voxel_m: f64,
    /// Columns of voxels.
    pub n_columns: u64,
    /// Blocks that are known.
    pub n_blocks: usize,
    /// Things, and their Gaussians.
    pub n_things: usize,
    /// See above.
    pub n_gaussians: u64,
    /// Searches that end with poses.
    pub found: Percentiles,
    /// Searches for things that no place shows: each is looked at a second time, from many more places.
    pub hidden: Percentiles,
    /// The machine.
    pub machine: Machine,
}

/// A box on the ground.
struct Thing {
    at: DVec3,
    half: DVec3,
    is_fenced: bool,
}

impl Thing {
    /// Returns how far a point lies outside of the box and its fence, by the largest component; negative inside.
    fn outside(&self, point: DVec3) -> f64 {
        let of_box = |by: f64, higher: f64| {
            ((point - self.at).abs() - self.half - DVec3::new(by, by, higher)).max_element()
        };
        let [from, thick] = FENCE_M;
        let fence = of_box(from + thick, from).max(-of_box(from, f64::INFINITY));
        if self.is_fenced { of_box(0.0, 0.0).min(fence) } else { of_box(0.0, 0.0) }
    }

    /// Returns points of its sides and top.
    fn surface(&self) -> Vec<DVec3> {
        let n = (2.0 * self.half / GAP_M).ceil().as_uvec3().to_array();
        let all = (0..=n[0]).flat_map(|x| (0..=n[1]).flat_map(move |y| (0..=n[2]).map(move |z| [x, y, z])));
        let is_outside = |at: &[u32; 3]| (0..3).any(|a| at[a] == n[a] || a < 2 && at[a] == 0);
        let share = |at: [u32; 3]| DVec3::from([0, 1, 2].map(|a| f64::from(at[a]) / f64::from(n[a])));
        all.filter(is_outside).map(|at| self.at + self.half * (2.0 * share(at) - 1.0)).collect()
    }
}

/// Times searches from the middle of a made yard, each for another thing; every one looks at ground and ways anew. The cache lies
/// in `work_dir` meanwhile.
///
/// # Errors
/// [`RobotError`].
pub fn time_goal(range_m: f64, voxel_m: f64, n_runs: u64, work_dir: &Path) -> Result<GoalTiming, RobotError> {
    let things = things(range_m);
    let blocks = blocks(range_m, voxel_m, &things);
    let mut cells = Vec::new();
    for quarter in 0..4u32 {
        cells.push(cell(quarter, range_m, voxel_m, &things, &blocks)?);
    }
    let n_gaussians = cells.iter().map(|cell| u64::from(cell.n_gaussians)).sum();
    let published = Published::new(cells, 1, DIM, &generate_key());
    let robot = Robot::start(&Arc::new(RwLock::new(published)), DIM, work_dir)?;
    robot.fetch()?;
    let agent: ureq::Agent = ureq::Agent::config_builder().proxy(None).build().into();
    let (mut found_ms, mut hidden_ms) = (Vec::new(), Vec::new());
    for run in 0..N_WARM_UP + n_runs {
        let text = run % N_CONCEPTS.min(things.len().max(1) as u64);
        let url = format!("{}/v1/goal?text={text}&near=0,0,0&range_m={range_m}", robot.service);
        let start = Instant::now();
        let body = agent.get(&url).call().and_then(|mut reply| reply.body_mut().read_to_string());
        let ms = start.elapsed().as_secs_f64() * 1e3;
        let refused = |what: String| RobotError::Query { what };
        let body: serde_json::Value = body
            .map_err(|e| refused(e.to_string()))
            .and_then(|body| serde_json::from_str(&body).map_err(|e| refused(e.to_string())))?;
        let is_found = body["goals"].as_array().is_some_and(|goals| !goals.is_empty());
        if body["thing"].is_null() && body["missed"].as_array().is_none_or(Vec::is_empty) {
            return Err(refused(body.to_string()));
        }
        if run >= N_WARM_UP {
            if is_found { &mut found_ms } else { &mut hidden_ms }.push(ms);
        }
    }
    robot.end()?;
    Ok(GoalTiming {
        range_m,
        voxel_m,
        n_columns: (2.0 * range_m / voxel_m).powi(2) as u64,
        n_blocks: blocks.len(),
        n_things: things.len(),
        n_gaussians,
        found: percentiles(found_ms),
        hidden: percentiles(hidden_ms),
        machine: Machine::here(),
    })
}

fn percentiles(mut ms: Vec<f64>) -> Percentiles {
    let n = ms.len() as u64;
    let mut at = |rank| quantile(&mut ms, rank);
    Percentiles { n, median_ms: at(500), p99_ms: at(990), max_ms: at(1000) }
}

/// Returns boxes anywhere but where the robot is.
fn things(range_m: f64) -> Vec<Thing> {
    let mut random = Random::new(1);
    let n = (THINGS_PER_100_M2 * (2.0 * range_m).powi(2) / 100.0) as usize;
    let boxes: Vec<(DVec3, DVec3)> = (0..n)
        .map(|_| {
            let half =
                DVec3::new(random.between(0.1, 0.6), random.between(0.1, 0.6), random.between(0.2, 1.0));
            let at = [0; 2].map(|_| random.between(-range_m, range_m));
            (DVec3::new(at[0], at[1], half.z), half)
        })
        .filter(|(at, half)| at.truncate().length() > 1.0 + half.truncate().length())
        .collect();
    (0..).zip(boxes).map(|(i, (at, half))| Thing { at, half, is_fenced: i % FENCED == FENCED - 1 }).collect()
}

/// Returns the blocks of a ground at z = 0 with things on it: the surfaces are occupied, the insides unknown, all else free.
fn blocks(range_m: f64, voxel_m: f64, things: &[Thing]) -> Vec<Block> {
    let block_m = voxel_m * f64::from(BLOCK_EDGE);
    let n = (range_m / block_m).ceil() as i32;
    let n_z = (HEIGHT_M / block_m).ceil() as i32;
    let mut blocks = Vec::new();
    for (x, y) in (-n..n).flat_map(|x| (-n..n).map(move |y| (x, y))) {
        let low = DVec3::new(f64::from(x), f64::from(y), 0.0) * block_m;
        let touches = |thing: &&Thing| {
            let near = thing.half.truncate() + block_m + FENCE_M.iter().sum::<f64>();
            ((low.truncate() + block_m / 2.0 - thing.at.truncate()).abs()).cmple(near).all()
        };
        let near: Vec<&Thing> = things.iter().filter(touches).collect();
        for z in -1..n_z {
            let mut block = Block { at: [x, y, z], occupied: 0, free: 0 };
            for bit in 0..64i32 {
                let offset =
                    DVec3::new(f64::from(bit / 16), f64::from(bit / 4 % 4), f64::from(bit % 4)) + 0.5;
                let centre = low + DVec3::Z * (f64::from(z) * block_m) + offset * voxel_m;
                match near.iter().map(|thing| thing.outside(centre)).fold(centre.z, f64::min) {
                    depth if depth > 0.0 => block.free |= 1 << bit,
                    depth if depth > -voxel_m => block.occupied |= 1 << bit,
                    _ => {}
                }
            }
            blocks.push(block);
        }
    }
    blocks
}

/// Returns the cell of one quarter of the yard. Each thing in it is an object with its own centroid; the text `i` asks for
/// thing `i`.
fn cell(quarter: u32, range_m: f64, voxel_m: f64, things: &[Thing], blocks: &[Block]) -> io::Result<Cell> {
    let is_here = |x: bool, y: bool| u32::from(x) + 2 * u32::from(y) == quarter;
    let here = (0u64..).zip(things).filter(|(_, thing)| is_here(thing.at.x >= 0.0, thing.at.y >= 0.0));
    let blocks: Vec<Block> =
        blocks.iter().copied().filter(|block| is_here(block.at[0] >= 0, block.at[1] >= 0)).collect();
    let low = |of: u32| if quarter & of == 0 { -range_m } else { 0.0 };
    let min = DVec3::new(low(1), low(2), 0.0) - MARGIN_M;
    let size = range_m + 2.0 * MARGIN_M;
    let bounds = Aabb { min, max: min + size };
    let step = size / f64::from(u16::MAX);

    let (mut positions, mut object_of, mut centroid_starts) = (Vec::new(), Vec::new(), vec![0u32]);
    let (mut records, mut codebook) = (Vec::new(), Vec::new());
    for (number, (id, thing)) in (0u16..).zip(here) {
        let surface = thing.surface();
        positions.extend(surface.iter().map(|p| ((*p - min) / step).round().as_u16vec3().to_array()));
        object_of.resize(positions.len(), number);
        centroid_starts.push(positions.len() as u32);
        codebook.extend(concept(id, DIM));
        records.push(ObjectRecord {
            id,
            position_in_world: thing.at.into(),
            box_min: (thing.at - thing.half).into(),
            box_max: (thing.at + thing.half).into(),
            n_gaussians: surface.len() as u32,
            n_gaussians_here: surface.len() as u32,
            photo_box_px: [0; 4],
            photo_start: 0,
            photo_bytes: 0,
        });
    }
    let (n_gaussians, n_centroids) = (positions.len() as u32, records.len() as u32);
    let (centroids, centroid_step) = shard::quantise(&codebook);
    let vectors = codebook.chunks(DIM as usize).map(|vector| quantise_vectors(vector, DIM as usize, 1));
    let (components, steps): (Vec<Vec<i8>>, Vec<Vec<f32>>) = vectors.unzip();
    let (run_ends, run_objects) = collect_runs(object_of);
    let objects = Objects {
        header: ObjectsHeader {
            n_objects: n_centroids,
            n_vectors: 1,
            n_runs: run_ends.len() as u32,
            photos_bytes: 0,
            score_mean: 0.0,
            score_spread: 0.0,
            score_error_bound: 0.01,
        },
        records: &records,
        vectors: &components.concat(),
        steps: &steps.concat(),
        run_ends: &run_ends,
        run_objects: &run_objects,
        photos: &[],
    };
    let places = BuiltOccupancy::pack(voxel_m, 0.1, 2, &blocks);
    let header = ShardHeader {
        cell_id: quarter,
        n_gaussians,
        n_centroids,
        dim: DIM,
        n_components: DIM,
        n_subspaces: 0,
        position_bits: [16, 16, 16, 0],
        centroid_step,
        origin_in_world: min.into(),
        position_step: [step; 3],
        box_min: bounds.min.into(),
        box_max: bounds.max.into(),
        errors: ScoreErrors::default(),
        encoder_id: encoder_id().0,
    };
    let view = ShardView {
        header,
        positions: Positions::Wide(&positions),
        centroid_starts: &centroid_starts,
        centroids: &centroids,
        radii: &vec![0.1; n_centroids as usize],
        basis: None,
        residuals: None,
        exact: None,
        packed_indices: None,
    };
    let mut out = Vec::new();
    let additions =
        Additions { objects: Some(&objects), occupancy: Some(&places.view()), ..Additions::default() };
    view.write_with(&mut out, additions)?;
    Ok(Cell { bounds, n_gaussians, n_centroids, shard: out })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By the yard: of its 15 things the eighth has a fence, and 16 searches ask for it once. (Times are reported, not asserted.)
    #[test]
    fn free_things_are_found_and_fenced_ones_are_not() {
        let dir = tempfile::tempdir().expect("a folder");
        let timing = time_goal(6.0, 0.1, 16, dir.path()).expect("measures");
        assert_eq!((timing.found.n, timing.hidden.n), (15, 1), "{timing:?}");
    }
}
