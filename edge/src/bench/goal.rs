//! Times the search for places to stand, in a made yard that is known everywhere.

use std::time::Instant;

use glam::DVec3;
use serde::Serialize;
use slag_common::occupancy::{BLOCK_EDGE, Block, BuiltOccupancy};
use slag_math::random::Random;

use super::machine::Machine;
use super::timing::quantile;
use crate::goal::{GoalError, GoalRequest, GoalTarget, stand};

/// Height up to which places are known, metres.
const HEIGHT_M: f64 = 2.4;
/// Boxes and posts in each 100 square metres.
const THINGS_PER_100_M2: f64 = 12.0;

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
    /// Bytes of the occupancy.
    pub len_bytes: u64,
    /// Searches, each for another thing.
    pub n_runs: usize,
    /// Those with a pose.
    pub n_found: usize,
    /// Median time.
    pub median_ms: f64,
    /// 99th percentile.
    pub p99_ms: f64,
    /// The machine.
    pub machine: Machine,
}

/// Times searches from the middle of a made yard, from the stored places on: nothing is kept from one search to the next.
///
/// # Errors
/// The range is too large for the voxels.
pub fn time_goal(range_m: f64, voxel_m: f64, n_runs: usize) -> Result<GoalTiming, GoalError> {
    let request = GoalRequest { range_m, ..GoalRequest::new(GoalTarget::Object(0)) };
    request.check()?;
    let mut random = Random::new(1);
    let n_things = (THINGS_PER_100_M2 * (2.0 * range_m).powi(2) / 100.0) as usize;
    let things: Vec<(DVec3, DVec3)> = (0..n_things)
        .map(|_| {
            let half =
                DVec3::new(random.between(0.1, 0.6), random.between(0.1, 0.6), random.between(0.2, 1.0));
            let at = [0; 2].map(|_| random.between(-range_m, range_m));
            (DVec3::new(at[0], at[1], half.z), half)
        })
        .filter(|(at, half)| at.truncate().length() > 1.0 + half.truncate().length())
        .collect();
    let blocks = blocks(range_m, voxel_m, &things);
    let places = BuiltOccupancy::pack(voxel_m, 0.1, 2, &blocks);
    let (mut times_ms, mut n_found) = (Vec::new(), 0);
    for run in 0..n_runs {
        let points = surface(&things[run % things.len().max(1)]);
        let start = Instant::now();
        let found = stand(&[places.view()], &request, DVec3::ZERO, &points)?;
        times_ms.push(start.elapsed().as_secs_f64() * 1e3);
        n_found += usize::from(found.is_ok());
    }
    Ok(GoalTiming {
        range_m,
        voxel_m,
        n_columns: (2.0 * range_m / voxel_m).powi(2) as u64,
        n_blocks: blocks.len(),
        len_bytes: places.len_bytes(),
        n_runs,
        n_found,
        median_ms: quantile(&mut times_ms, 500),
        p99_ms: quantile(&mut times_ms, 990),
        machine: Machine::here(),
    })
}

/// Returns the blocks of a ground at z = 0 with boxes on it: the surfaces are occupied, the insides unknown, all else free.
fn blocks(range_m: f64, voxel_m: f64, things: &[(DVec3, DVec3)]) -> Vec<Block> {
    let block_m = voxel_m * f64::from(BLOCK_EDGE);
    let n = (range_m / block_m).ceil() as i32;
    let n_z = (HEIGHT_M / block_m).ceil() as i32;
    let mut blocks = Vec::new();
    for (x, y) in (-n..n).flat_map(|x| (-n..n).map(move |y| (x, y))) {
        let low = DVec3::new(f64::from(x), f64::from(y), 0.0) * block_m;
        let touches = |(at, half): &&(DVec3, DVec3)| {
            let near = half.truncate() + block_m;
            ((low.truncate() + block_m / 2.0 - at.truncate()).abs()).cmple(near).all()
        };
        let near: Vec<&(DVec3, DVec3)> = things.iter().filter(touches).collect();
        for z in -1..n_z {
            let mut block = Block { at: [x, y, z], occupied: 0, free: 0 };
            for bit in 0..64i32 {
                let offset =
                    DVec3::new(f64::from(bit / 16), f64::from(bit / 4 % 4), f64::from(bit % 4)) + 0.5;
                let centre = low + DVec3::Z * (f64::from(z) * block_m) + offset * voxel_m;
                let outside = |(at, half): &&(DVec3, DVec3)| ((centre - at).abs() - half).max_element();
                let depth = near.iter().map(outside).fold(centre.z, f64::min);
                match depth {
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

/// Returns points on the sides of a box.
fn surface((at, half): &(DVec3, DVec3)) -> Vec<DVec3> {
    let steps = [-1.0, -0.5, 0.0, 0.5, 1.0];
    let all = steps
        .into_iter()
        .flat_map(|x| steps.into_iter().flat_map(move |y| steps.map(|z| DVec3::new(x, y, z))));
    all.filter(|p| p.truncate().abs().max_element() == 1.0).map(|p| *at + p * *half).collect()
}
