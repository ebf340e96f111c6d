//! Visibility of a thing to a sensor: straight lines through free places.

use std::collections::HashSet;

use glam::DVec3;
use slag_common::occupancy::BLOCK_EDGE;

use super::ground::voxels_of;
use super::space::{COLUMN_BLOCKS, Space};

/// Distance from a point of the thing within which the line need not be free, in edges of a voxel: the
/// thing's own surface and the voxels just before it are occupied or unknown.
const TOLERANCE: f64 = 2.0;
const HEIGHT: i32 = COLUMN_BLOCKS * BLOCK_EDGE;
/// Most columns of voxels in the local table, 17 MB; lines to larger things look up every voxel.
const MAX_AT_HAND: usize = 1 << 19;

/// The voxels of a column, by height.
type Bits = [u64; HEIGHT as usize / 64];

/// A thing, prepared for tests of lines of sight.
pub struct Thing<'a> {
    space: &'a Space,
    /// Cells of the local table: first, and along x and y.
    first: [i32; 2],
    n: [usize; 2],
    /// By local cell: free voxels.
    free: Vec<Bits>,
    /// Voxels with a point of it and their neighbours: voxels are occupied up to 0.94 edges from a surface.
    own: Vec<Bits>,
    /// Own voxels outside the local table.
    own_elsewhere: HashSet<[i32; 3]>,
    /// Lowest voxel wholly above its bottom.
    first_above_bottom: i32,
    /// Height of its bottom, world frame.
    bottom: f64,
}

impl<'a> Thing<'a> {
    /// Prepares the thing with a surface at `points` for sensors up to `reach_m` from it.
    pub fn new(space: &'a Space, points: &[DVec3], reach_m: f64) -> Self {
        let window = &space.window;
        let edge = BLOCK_EDGE as usize;
        let voxels = || points.iter().map(|point| window.voxel_of(*point));
        let reach = (reach_m / window.voxel).ceil() as i32 + 2;
        // Whole columns of blocks inside the window.
        let blocks = |axis: usize| {
            let of_axis = || voxels().map(|voxel| voxel[axis]);
            let low = of_axis().min().unwrap_or(0).saturating_sub(reach).div_euclid(BLOCK_EDGE);
            let high = of_axis().max().unwrap_or(0).saturating_add(reach).div_euclid(BLOCK_EDGE);
            let clip = |at: i32| at.clamp(0, window.n[axis] as i32) as usize;
            clip(low)..clip(high + 1)
        };
        let [xs, mut ys] = [blocks(0), blocks(1)];
        if xs.len() * ys.len() * edge * edge > MAX_AT_HAND {
            ys = 0..0;
        }
        let n = [xs.len() * edge, ys.len() * edge];
        let mut free = vec![Bits::default(); n[0] * n[1]];
        for (x, y) in xs.clone().flat_map(|x| ys.clone().map(move |y| (x, y))) {
            let corner = (x - xs.start) * edge * n[1] + (y - ys.start) * edge;
            for (cell, [_, of_cell]) in voxels_of(space.column(x * window.n[1] + y)).into_iter().enumerate() {
                free[corner + cell / edge * n[1] + cell % edge] = [of_cell as u64, (of_cell >> 64) as u64];
            }
        }
        let bottom = points.iter().map(|point| point.z).fold(f64::INFINITY, f64::min);
        let [.., z] = window.voxel_of(DVec3::Z * bottom);
        let mut thing = Self {
            space,
            first: [xs.start, ys.start].map(|at| at as i32 * BLOCK_EDGE),
            n,
            own: vec![Bits::default(); free.len()],
            free,
            own_elsewhere: HashSet::new(),
            first_above_bottom: z.saturating_add(1),
            bottom,
        };
        for [x, y, z] in voxels() {
            let beside = |of: i32| of.saturating_sub(1)..=of.saturating_add(1);
            for at in beside(x).flat_map(|x| beside(y).flat_map(move |y| beside(z).map(move |z| [x, y, z]))) {
                match thing.cell(at) {
                    Some(cell) => thing.own[cell][at[2] as usize / 64] |= 1 << (at[2] % 64),
                    None => _ = thing.own_elsewhere.insert(at),
                }
            }
        }
        thing
    }

    /// Returns the cell of a voxel in the local table.
    fn cell(&self, [x, y, z]: [i32; 3]) -> Option<usize> {
        let x = x.wrapping_sub(self.first[0]) as u32 as usize;
        let y = y.wrapping_sub(self.first[1]) as u32 as usize;
        let is_at_hand = x < self.n[0] && y < self.n[1] && (0..HEIGHT).contains(&z);
        is_at_hand.then(|| x * self.n[1] + y)
    }

    fn is_free(&self, at: [i32; 3]) -> bool {
        match self.cell(at) {
            Some(cell) => self.free[cell][at[2] as usize / 64] >> (at[2] % 64) & 1 != 0,
            None => {
                let (block, bit) = place(at);
                self.space.free(block) & bit != 0
            }
        }
    }

    fn may_occupy(&self, at: [i32; 3]) -> bool {
        match self.cell(at) {
            Some(cell) => self.own[cell][at[2] as usize / 64] >> (at[2] % 64) & 1 != 0,
            None => self.own_elsewhere.contains(&at),
        }
    }
}

fn place(at: [i32; 3]) -> ([i32; 3], u64) {
    let [x, y, z] = at.map(|v| v.rem_euclid(BLOCK_EDGE));
    (at.map(|v| v.div_euclid(BLOCK_EDGE)), 1 << (z + BLOCK_EDGE * (y + BLOCK_EDGE * x)))
}

/// Returns whether a sensor in the voxel `at` sees a point of a thing: every voxel on the line is free until
/// the line enters voxels that the thing's own surface may occupy, and stays in them, or comes within
/// [`TOLERANCE`] of the point. Unknown voxels hide what is behind them.
///
/// A sensor below the whole thing looks at the board or table that carries it. Their highest voxels belong to
/// both, so only voxels wholly above the thing's bottom count as its own.
///
/// Voxel traversal: Amanatides and Woo, "A Fast Voxel Traversal Algorithm" (1987).
pub fn sees(thing: &Thing<'_>, sensor: DVec3, at: [i32; 3], point: DVec3) -> bool {
    let window = &thing.space.window;
    let voxel = window.voxel;
    let line = point - sensor;
    let lowest = if sensor.z < thing.bottom { thing.first_above_bottom } else { i32::MIN };
    let corner = DVec3::from(window.first.map(|b| f64::from(b * BLOCK_EDGE))) * voxel;
    let length = line.length();
    if length <= 0.0 {
        return true;
    }
    let direction = line / length;
    let mut next = [f64::INFINITY; 3];
    let between = (voxel / direction).abs().to_array();
    for axis in 0..3 {
        if direction[axis] != 0.0 {
            let side =
                corner[axis] + (f64::from(at[axis]) + f64::from(u8::from(direction[axis] > 0.0))) * voxel;
            next[axis] = (side - sensor[axis]) / direction[axis];
        }
    }
    let step = direction.to_array().map(|along| if along > 0.0 { 1 } else { -1 });
    let mut walk = Walk { at, entered: 0.0, next, between, step };
    let mut is_at_thing = false;
    loop {
        let is_free = thing.is_free(walk.at);
        if !is_free || is_at_thing {
            is_at_thing = true;
            let is_near = walk.entered >= length - TOLERANCE * voxel || thing.may_occupy(walk.at);
            if !is_near || !is_free && walk.at[2] < lowest {
                return false;
            }
        }
        walk.go_on();
        if walk.entered >= length {
            return true;
        }
    }
}

struct Walk {
    at: [i32; 3],
    /// Distances along the line: to the voxel's entry, to the next side across each axis, and between two sides.
    entered: f64,
    next: [f64; 3],
    between: [f64; 3],
    step: [i32; 3],
}

impl Walk {
    fn go_on(&mut self) {
        let [x, y, z] = self.next;
        // One branch per axis avoids waiting for a computed index.
        match (y < x, z < x.min(y)) {
            (_, true) => self.pass(2),
            (true, _) => self.pass(1),
            _ => self.pass(0),
        }
    }

    #[inline(always)]
    fn pass(&mut self, axis: usize) {
        self.entered = self.next[axis];
        self.at[axis] += self.step[axis];
        self.next[axis] += self.between[axis];
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use slag_common::occupancy::{Block, BuiltOccupancy};
    use slag_math::random::Random;

    use super::*;
    use crate::goal::space::Window;
    use crate::score::Budget;

    /// Oracle: the voxels of two shards' blocks, and every point beside every voxel, in the local table or not.
    #[test]
    fn voxels_around_a_thing_are_those_of_the_shards() {
        let mut random = Random::new(6);
        let window = Window::around(DVec3::ZERO, 1.0, 0.1);
        let all = (-3..3).flat_map(|x| (-3..3).flat_map(move |y| (-8..30).map(move |z| [x, y, z])));
        let blocks: Vec<Block> =
            all.map(|at| Block { at, occupied: 0, free: random.bits() | random.bits() }).collect();
        let free: BTreeMap<[i32; 3], u64> = blocks.iter().map(|block| (block.at, block.free)).collect();
        let of_shard = |odd: bool| -> Vec<Block> {
            blocks.iter().copied().filter(|block| (block.at.iter().sum::<i32>() % 2 != 0) == odd).collect()
        };
        let packed = [false, true].map(|odd| BuiltOccupancy::pack(0.1, 0.1, 2, &of_shard(odd)));
        let shards = [packed[0].view(), packed[1].view()];
        let space = Space::gather(window, &shards, &Budget::default()).expect("few blocks");
        let n = window.cells().map(|n| n as i32);
        // Also a thing that reaches out of the window.
        for (centre, reach_m) in [(0.0, 0.0), (0.2, 0.3), (-1.2, 0.2), (0.0, 9.0)] {
            let point = |random: &mut Random| {
                DVec3::new(0.0, 0.0, 0.4) + DVec3::from([0; 3].map(|_| centre + random.between(-0.3, 0.3)))
            };
            let points: Vec<DVec3> = (0..9).map(|_| point(&mut random)).collect();
            let thing = Thing::new(&space, &points, reach_m);
            let voxels: Vec<[i32; 3]> = points.iter().map(|point| window.voxel_of(*point)).collect();
            let is_beside = |of: &[i32; 3], at: [i32; 3]| (0..3).all(|axis| (of[axis] - at[axis]).abs() <= 1);
            for at in (-9..n[0] + 2)
                .flat_map(|x| (-9..n[1] + 2).flat_map(move |y| (-2..130).map(move |z| [x, y, z])))
            {
                let on_lattice = [0, 1, 2].map(|axis| at[axis] + window.first[axis] * BLOCK_EDGE);
                let is_inside = (0..3).all(|axis| at[axis] >= 0 && at[axis] < [n[0], n[1], HEIGHT][axis]);
                let [x, y, z] = on_lattice.map(|v| v.rem_euclid(BLOCK_EDGE));
                let of_block = free.get(&on_lattice.map(|v| v.div_euclid(BLOCK_EDGE)));
                let is_free = of_block.is_some_and(|free| free >> (z + 4 * (y + 4 * x)) & 1 == 1);
                assert_eq!(thing.is_free(at), is_inside && is_free, "{at:?}");
                assert_eq!(thing.may_occupy(at), voxels.iter().any(|of| is_beside(of, at)), "{at:?}");
            }
        }
    }
}
