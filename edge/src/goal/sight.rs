//! What a sensor sees of a thing: straight lines through free places.

use std::collections::{BTreeSet, HashMap};

use glam::DVec3;
use slag_common::occupancy::BLOCK_EDGE;

use super::space::{Space, Window};

/// Distance from a point of the thing within which the line need not be free, in edges of a voxel: the thing's own surface, and
/// the voxels just before it, are occupied or unknown.
const TOLERANCE: f64 = 2.0;

/// A thing, as lines of sight meet it.
pub struct Thing {
    /// By block: the voxels that its surface may occupy, those with a point of it and their neighbours. Voxels are occupied up to
    /// 0.94 edges from a surface, so there are no others.
    blocks: HashMap<[i32; 3], u64>,
    /// The lowest voxel that lies wholly above its bottom.
    first_above_bottom: i32,
    /// Height of its bottom, world frame.
    bottom: f64,
}

impl Thing {
    /// Makes the thing with a surface at `points`.
    pub fn new(window: &Window, points: &[DVec3]) -> Self {
        let voxels: BTreeSet<[i32; 3]> = points.iter().map(|point| window.voxel_of(*point)).collect();
        let mut blocks: HashMap<[i32; 3], u64> = HashMap::new();
        for [x, y, z] in voxels {
            let beside = |of: i32| of.saturating_sub(1)..=of.saturating_add(1);
            for at in beside(x).flat_map(|x| beside(y).flat_map(move |y| beside(z).map(move |z| [x, y, z]))) {
                let (block, bit) = place(at);
                *blocks.entry(block).or_default() |= bit;
            }
        }
        let bottom = points.iter().map(|point| point.z).fold(f64::INFINITY, f64::min);
        let [.., z] = window.voxel_of(DVec3::Z * bottom);
        Self { blocks, first_above_bottom: z.saturating_add(1), bottom }
    }

    fn may_occupy(&self, block: [i32; 3], bit: u64) -> bool {
        self.blocks.get(&block).is_some_and(|mask| mask & bit != 0)
    }
}

/// Returns the block of a voxel, and its bit there.
fn place(at: [i32; 3]) -> ([i32; 3], u64) {
    let [x, y, z] = at.map(|v| v.rem_euclid(BLOCK_EDGE));
    (at.map(|v| v.div_euclid(BLOCK_EDGE)), 1 << (z + BLOCK_EDGE * (y + BLOCK_EDGE * x)))
}

/// Returns whether a point of a thing is seen: every voxel on the line from the sensor is free until the line enters voxels that
/// the thing's own surface may occupy, which it does not leave, or comes within [`TOLERANCE`] of the point.
///
/// A sensor below the whole thing looks at the board or the table that carries it. Their highest voxels belong to both, so only
/// those that lie wholly above the thing's bottom count as the thing's.
///
/// The voxels that a line passes are those of Amanatides and Woo, "A Fast Voxel Traversal Algorithm" (1987). Unknown ones hide
/// what is behind them.
pub fn sees(space: &Space, thing: &Thing, sensor: DVec3, point: DVec3) -> bool {
    let voxel = space.window.voxel;
    let line = point - sensor;
    let length = line.length();
    if length <= 0.0 {
        return true;
    }
    let lowest = if sensor.z < thing.bottom { thing.first_above_bottom } else { i32::MIN };
    let direction = line / length;
    let mut at = space.window.voxel_of(sensor);
    let corner = DVec3::from(space.window.first.map(|b| f64::from(b * BLOCK_EDGE))) * voxel;
    // Distance along the line to the next side of a voxel, and between two sides.
    let mut next = DVec3::INFINITY;
    let between = (voxel / direction).abs();
    for axis in 0..3 {
        if direction[axis] != 0.0 {
            let side =
                corner[axis] + (f64::from(at[axis]) + f64::from(u8::from(direction[axis] > 0.0))) * voxel;
            next[axis] = (side - sensor[axis]) / direction[axis];
        }
    }
    let (mut entered, mut is_at_thing) = (0.0, false);
    // A line stays in a block for several voxels.
    let (mut known, mut free) = (None, 0);
    loop {
        let (block, bit) = place(at);
        if known != Some(block) {
            (known, free) = (Some(block), space.free(block));
        }
        let is_free = free & bit != 0;
        if !is_free || is_at_thing {
            is_at_thing = true;
            let is_near = entered >= length - TOLERANCE * voxel || thing.may_occupy(block, bit);
            if !is_near || !is_free && at[2] < lowest {
                return false;
            }
        }
        let axis = (0..3).fold(0, |least, axis| if next[axis] < next[least] { axis } else { least });
        if next[axis] >= length {
            return true;
        }
        entered = next[axis];
        at[axis] += if direction[axis] > 0.0 { 1 } else { -1 };
        next[axis] += between[axis];
    }
}
