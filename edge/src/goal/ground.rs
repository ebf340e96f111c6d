//! The ground: in each column of voxels, the surface that continues the one that the robot stands on.

use rayon::prelude::*;
use slag_common::occupancy::BLOCK_EDGE;

use super::space::{Space, Stacked};

/// How far a surface lies below the upper side of its highest occupied voxel, in edges of a voxel: voxels are
/// occupied up to 0.94 edges from a surface, so it lies 0.94 to 1.44 edges below (`docs/numerics.md`).
pub const SURFACE_DEPTH: f64 = 1.2;

/// Voxels that a level surface occupies at most: those with centres up to 0.94 edges from it.
const SURFACE_VOXELS: u32 = 2;

/// What a cell, a column of voxels, holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Floor {
    Unknown,
    /// Occupied without headroom.
    Blocked,
    /// Ground; its highest occupied voxel, from the window's lower side.
    At(u8),
}

pub struct Ground {
    /// `[n_x][n_y]`.
    pub floors: Vec<Floor>,
    pub n_y: usize,
    /// `[n_x][n_y]`: surfaces with headroom; bit z: the surface with its highest voxel at z.
    surfaces: Vec<u128>,
}

/// Half the path over which a slope is measured, metres.
const SLOPE_REACH_M: f64 = 0.5;

impl Ground {
    #[cfg(test)]
    pub fn of(floors: Vec<Floor>, n_y: usize) -> Self {
        Self { surfaces: vec![0; floors.len()], floors, n_y }
    }

    /// Finds the ground. `headroom`: free voxels that must lie above, 1 to 128. Columns without ground are
    /// obstacles if their lowest surface is higher than `step` voxels or another lies within the headroom
    /// above it; anything higher, such as a ceiling, is in no robot's way.
    pub fn find(space: &Space, headroom: u32, step: u32) -> Self {
        let edge = BLOCK_EDGE as usize;
        let [n_columns_x, n_columns_y] = space.window.n;
        let n_y = n_columns_y * edge;
        let mut floors = vec![Floor::Unknown; n_columns_x * edge * n_y];
        let mut surfaces = vec![0u128; floors.len()];
        // One chunk per x of the columns: four rows of cells.
        let rows = floors.par_chunks_mut(edge * n_y).zip(surfaces.par_chunks_mut(edge * n_y));
        rows.enumerate().for_each(|(x, (rows, of_rows))| {
            let mut last = (0, 0, (Floor::Unknown, 0));
            for y in 0..n_columns_y {
                let voxels = voxels_of(space.column(x * n_columns_y + y));
                for (cell, [occupied, free]) in voxels.into_iter().enumerate() {
                    // Most columns of voxels equal the one before.
                    if (occupied ^ last.0) | (free ^ last.1) != 0 {
                        let surfaces = surfaces_of(occupied, free, headroom);
                        last = (occupied, free, (floor(occupied, surfaces, headroom, step), surfaces));
                    }
                    let at = cell / edge * n_y + y * edge + cell % edge;
                    (rows[at], of_rows[at]) = last.2;
                }
            }
        });
        Self { floors, n_y, surfaces }
    }

    /// Returns the highest surface of a cell at or below a height.
    pub(crate) fn surface_below(&self, cell: usize, height: i32) -> Option<u8> {
        let n = u32::try_from(height.checked_add(1)?).ok()?;
        let below = self.surfaces[cell] & low_bits(n.min(128));
        below.checked_ilog2().map(|z| z as u8)
    }

    /// Continues a surface from a cell: what a robot that climbs `step` voxels reaches over neighbours is ground,
    /// even above a lower surface (furniture of the storey below). A column with such a lower surface and one at the
    /// robot's height is an obstacle, not a drop. Returns which cells are ground.
    pub(crate) fn continue_from(&mut self, cell: usize, z: u8, step: u8, headroom: u32) -> Vec<bool> {
        let (n_y, n) = (self.n_y, self.floors.len());
        let mut is_met = vec![false; n];
        (self.floors[cell], is_met[cell]) = (Floor::At(z), true);
        let mut border = std::collections::VecDeque::from([(cell, z)]);
        while let Some((cell, z)) = border.pop_front() {
            let y = cell % n_y;
            let beside = [
                cell.checked_sub(n_y),
                Some(cell + n_y).filter(|to| *to < n),
                cell.checked_sub(1).filter(|_| y > 0),
                Some(cell + 1).filter(|_| y + 1 < n_y),
            ];
            for to in beside.into_iter().flatten() {
                if is_met[to] {
                    continue;
                }
                // Another neighbour may be near enough in height.
                if let Some(z) = self.nearest_surface(to, z, step) {
                    (self.floors[to], is_met[to]) = (Floor::At(z), true);
                    border.push_back((to, z));
                } else if matches!(self.floors[to], Floor::At(low) if low < z)
                    && (self.surfaces[to] & low_bits(u32::from(z) + headroom + 1)) >> z != 0
                {
                    self.floors[to] = Floor::Blocked;
                }
            }
        }
        is_met
    }

    /// Returns the surface of a cell that is nearest to a height, at most a step away; of two the lower one.
    fn nearest_surface(&self, cell: usize, z: u8, step: u8) -> Option<u8> {
        let surfaces = self.surfaces[cell];
        let has = |z: Option<u8>| z.filter(|z| *z < 128 && surfaces >> z & 1 == 1);
        (0..=step).find_map(|d| has(z.checked_sub(d)).or_else(|| has(z.checked_add(d))))
    }

    /// Marks ground too steep for the robot as an obstacle: where a line of at most a metre rises or falls by
    /// more than `slope` times its length plus a step. Lines end at higher steps.
    pub(crate) fn block_slopes(&mut self, slope: f64, step: u8, voxel: f64) {
        let (n_y, floors) = (self.n_y, &self.floors);
        let n_x = floors.len() / n_y.max(1);
        let reach = (SLOPE_REACH_M / voxel).round().max(1.0) as usize;
        let height = |x: usize, y: usize| match floors[x * n_y + y] {
            Floor::At(z) => Some(i32::from(z)),
            _ => None,
        };
        // The cells along a line and the height at its end.
        let walk = |x: usize, y: usize, z: i32, (dx, dy): (isize, isize)| {
            let mut end = (0usize, z);
            for n in 1..=reach {
                let to = |at: usize, d: isize| at.checked_add_signed(d * n as isize);
                let (Some(x), Some(y)) = (to(x, dx), to(y, dy)) else { break };
                let next = if x < n_x && y < n_y { height(x, y) } else { None };
                let Some(next) = next.filter(|next| next.abs_diff(end.1) <= u32::from(step)) else { break };
                end = (n, next);
            }
            end
        };
        let is_steep = |cell: usize| {
            let (x, y) = (cell / n_y, cell % n_y);
            let Some(z) = height(x, y) else { return false };
            [(1, 0), (0, 1), (1, 1), (1, -1)].into_iter().any(|(dx, dy)| {
                let (ahead, behind) = (walk(x, y, z, (dx, dy)), walk(x, y, z, (-dx, -dy)));
                let diagonal = if dx * dy == 0 { 1.0 } else { std::f64::consts::SQRT_2 };
                let allowed = slope * diagonal * (ahead.0 + behind.0) as f64 + f64::from(step);
                f64::from(ahead.1.abs_diff(behind.1)) > allowed
            })
        };
        let steep: Vec<bool> = (0..floors.len()).into_par_iter().map(is_steep).collect();
        for (floor, _) in self.floors.iter_mut().zip(steep).filter(|(_, steep)| *steep) {
            *floor = Floor::Blocked;
        }
    }
}

/// Returns occupied and free voxels of the 16 voxel columns in a column of blocks; bit z: the voxel at height z.
pub fn voxels_of(blocks: &[Stacked]) -> [[u128; 2]; 16] {
    // Lower and upper half, by cell.
    let (mut occupied, mut free) = ([[0u64; 16]; 2], [[0u64; 16]; 2]);
    // Most blocks are entirely free.
    let mut all_free = 0;
    for block in blocks {
        let shift = u32::from(block.z) * BLOCK_EDGE as u32;
        if block.free == !0 {
            all_free |= 15 << shift;
            continue;
        }
        let add = |bits: u64, halves: &mut [[u64; 16]; 2]| {
            if bits != 0 {
                let half = &mut halves[shift as usize / 64];
                (0..16).for_each(|cell| half[cell] |= (bits >> (4 * cell) & 15) << (shift % 64));
            }
        };
        add(block.occupied, &mut occupied);
        add(block.free, &mut free);
    }
    let whole =
        |[low, high]: [[u64; 16]; 2], cell: usize| u128::from(high[cell]) << 64 | u128::from(low[cell]);
    std::array::from_fn(|cell| [whole(occupied, cell), whole(free, cell) | all_free])
}

fn low_bits(n: u32) -> u128 {
    1u128.checked_shl(n).map_or(!0, |bit| bit - 1)
}

fn surfaces_of(occupied: u128, free: u128, headroom: u32) -> u128 {
    let (mut surfaces, mut tops) = (0, occupied & !(occupied >> 1));
    while tops != 0 {
        let z = tops.trailing_zeros();
        if !(free >> z >> 1) & low_bits(headroom) == 0 {
            surfaces |= 1 << z;
        }
        tops &= tops - 1;
    }
    surfaces
}

/// Returns the lowest surface, or whether a column without one is in the way.
fn floor(occupied: u128, surfaces: u128, headroom: u32, step: u32) -> Floor {
    if occupied == 0 {
        return Floor::Unknown;
    }
    if surfaces != 0 {
        return Floor::At(surfaces.trailing_zeros() as u8);
    }
    let from_lowest = occupied >> occupied.trailing_zeros();
    let thickness = from_lowest.trailing_ones();
    let above = from_lowest.unbounded_shr(thickness) & low_bits(headroom);
    if thickness > SURFACE_VOXELS + step || above != 0 { Floor::Blocked } else { Floor::Unknown }
}

#[cfg(test)]
mod tests {
    use slag_math::random::Random;

    use super::*;

    fn floor(occupied: u128, free: u128, headroom: u32, step: u32) -> Floor {
        super::floor(occupied, surfaces_of(occupied, free, headroom), headroom, step)
    }

    /// Oracle: the definition, voxel by voxel.
    #[test]
    fn the_ground_is_the_lowest_surface_with_headroom() {
        let mut random = Random::new(4);
        let wide = |random: &mut Random| u128::from(random.bits()) << 64 | u128::from(random.bits());
        for round in 0..20_000 {
            let headroom = 1 + (random.bits() % 12) as u32;
            let occupied = wide(&mut random) & wide(&mut random) & wide(&mut random);
            // Mostly free, to leave headroom.
            let unknown = wide(&mut random) & wide(&mut random) & wide(&mut random) & wide(&mut random);
            let free = !occupied & !unknown;
            let bit = |mask: u128, z: u32| z < 128 && mask >> z & 1 == 1;
            let expected = (0..128).find(|z| bit(occupied, *z) && (1..=headroom).all(|h| bit(free, z + h)));
            match floor(occupied, free, headroom, 3) {
                Floor::At(found) => assert_eq!(Some(u32::from(found)), expected, "{round}"),
                _ => assert_eq!(expected, None, "{round}"),
            }
        }
    }

    /// By hand: a floor at 3 with free voxels 4 to 8, then a table top at 9.
    #[test]
    fn tables_are_ground_only_without_room_below() {
        let (occupied, free) = (1 << 3 | 1 << 9, 0b11111 << 4 | 0xfff << 10);
        assert_eq!(floor(occupied, free, 5, 2), Floor::At(3));
        assert_eq!(floor(occupied, free, 6, 2), Floor::At(9));
        assert_eq!(floor(occupied, free, 13, 2), Floor::Blocked);
        assert_eq!(floor(1 << 3, 0, 1, 2), Floor::Unknown, "nobody has seen the place above");
        assert_eq!(floor(0, !0, 1, 2), Floor::Unknown, "no ground");
    }

    /// By hand: unseen air between a floor at 3 and a ceiling at 60; a wall; a kerb.
    #[test]
    fn a_ceiling_blocks_nobody() {
        assert_eq!(floor(1 << 3 | 1 << 60, 0, 10, 2), Floor::Unknown);
        assert_eq!(floor(0b11 << 3 | 1 << 15 | 1 << 60, 0, 10, 2), Floor::Unknown);
        assert_eq!(floor(0b11 << 3 | 1 << 14 | 1 << 60, 0, 10, 2), Floor::Blocked);
        assert_eq!(floor(0b1111 << 3, 0, 10, 2), Floor::Unknown);
        assert_eq!(floor(0b11111 << 3, 0, 10, 2), Floor::Blocked);
        assert_eq!(floor(!0, 0, 128, 100), Floor::Blocked);
        assert_eq!(floor(1 | 1 << 127, 0, 128, 1), Floor::Blocked);
    }

    /// By hand: a row of cells with a floor at 5; the third has a surface at 1 below it (a table downstairs).
    #[test]
    fn ground_continues_at_the_robots_height() {
        let mut ground = Ground {
            floors: vec![Floor::At(5), Floor::At(5), Floor::At(1), Floor::At(6), Floor::At(9)],
            n_y: 5,
            surfaces: vec![1 << 5, 1 << 5, 1 << 1 | 1 << 5, 1 << 6, 1 << 9],
        };
        assert_eq!([3, 5, 200].map(|z| ground.surface_below(2, z)), [Some(1), Some(5), Some(5)]);
        assert_eq!(ground.surface_below(2, -1), None);
        ground.continue_from(0, 5, 1, 10);
        assert_eq!(ground.floors, [5, 5, 5, 6, 9].map(Floor::At));
        // Above a table of the storey below: a box in the way, a hole, and something hanging over the robot.
        for (surfaces, expected) in [
            (1_u128 << 1 | 1 << 12, Floor::Blocked),
            (1 << 1, Floor::At(1)),
            (1 << 1 | 1 << 16, Floor::At(1)),
            (1 << 12, Floor::At(12)),
        ] {
            let lowest = Floor::At(surfaces.trailing_zeros() as u8);
            let mut ground =
                Ground { floors: vec![Floor::At(5), lowest], n_y: 2, surfaces: vec![1 << 5, surfaces] };
            ground.continue_from(0, 5, 1, 10);
            assert_eq!(ground.floors[1], expected, "{surfaces:b}");
        }
    }

    /// By hand: rows that rise by a voxel each cell, each second, each third; a wall beside a floor is no slope.
    #[test]
    fn slopes_are_measured_over_their_length() {
        let blocked = |heights: &[u8], slope: f64| {
            let floors: Vec<Floor> = heights.iter().map(|z| Floor::At(*z)).collect();
            let mut ground = Ground { n_y: floors.len(), surfaces: vec![0; floors.len()], floors };
            ground.block_slopes(slope, 1, 0.05);
            ground.floors.iter().filter(|floor| **floor == Floor::Blocked).count()
        };
        let rising = |run: u8| (0..30).map(|i| i / run).collect::<Vec<u8>>();
        assert!(blocked(&rising(1), 0.5) > 25, "45 degrees");
        assert_eq!([blocked(&rising(2), 0.55), blocked(&rising(3), 0.5)], [0, 0]);
        assert!(blocked(&rising(2), 0.3) > 20);
        let wall: Vec<u8> = [vec![0; 15], vec![20; 15]].concat();
        assert_eq!(blocked(&wall, 0.1), 0);
    }
}
