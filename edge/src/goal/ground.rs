//! The ground: in each column of voxels the lowest surface with headroom.

use rayon::prelude::*;
use slag_common::occupancy::BLOCK_EDGE;

use super::space::{Space, Stacked};

/// How far a surface lies below the upper side of its highest occupied voxel, in edges of a voxel: voxels are occupied up to 0.94
/// edges from a surface, so it lies 0.94 to 1.44 edges below (`docs/numerics.md`).
pub const SURFACE_DEPTH: f64 = 1.2;

/// Voxels that a level surface occupies at most: those with centres up to 0.94 edges from it.
const SURFACE_VOXELS: u32 = 2;

/// What a cell, a column of voxels, holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Floor {
    /// Nothing that is known to be ground.
    Unknown,
    /// Something that leaves no headroom.
    Blocked,
    /// Ground; its highest occupied voxel, from the window's lower side.
    At(u8),
}

/// The ground of a space, by cell.
pub struct Ground {
    /// `[n_x][n_y]`.
    pub floors: Vec<Floor>,
    /// Cells along y.
    pub n_y: usize,
}

impl Ground {
    /// Finds the ground. `headroom`: free voxels that must lie above, 1 to 128. Columns without ground are obstacles where their
    /// lowest surface is higher than a `step`, in voxels, or another one lies within the headroom above it: what is higher, such
    /// as a ceiling, is in no robot's way.
    pub fn find(space: &Space, headroom: u32, step: u32) -> Self {
        let edge = BLOCK_EDGE as usize;
        let [n_columns_x, n_columns_y] = space.window.n;
        let n_y = n_columns_y * edge;
        let mut floors = vec![Floor::Unknown; n_columns_x * edge * n_y];
        // A piece for each x of the columns: four rows of cells.
        floors.par_chunks_mut(edge * n_y).enumerate().for_each(|(x, rows)| {
            let mut last = (0, 0, Floor::Unknown);
            for y in 0..n_columns_y {
                let voxels = voxels_of(space.column(x * n_columns_y + y));
                for (cell, [occupied, free]) in voxels.into_iter().enumerate() {
                    // Most columns of voxels are as the one before.
                    if (occupied ^ last.0) | (free ^ last.1) != 0 {
                        last = (occupied, free, floor(occupied, free, headroom, step));
                    }
                    rows[cell / edge * n_y + y * edge + cell % edge] = last.2;
                }
            }
        });
        Self { floors, n_y }
    }
}

/// Returns occupied and free voxels of the 16 columns of voxels in a column of blocks; bit z is the voxel at height z.
pub fn voxels_of(blocks: &[Stacked]) -> [[u128; 2]; 16] {
    // Lower and upper half, by cell.
    let (mut occupied, mut free) = ([[0u64; 16]; 2], [[0u64; 16]; 2]);
    // Most blocks are free as a whole.
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

/// Returns a mask of the lowest `n` bits.
fn low_bits(n: u32) -> u128 {
    1u128.checked_shl(n).map_or(!0, |bit| bit - 1)
}

fn floor(occupied: u128, free: u128, headroom: u32, step: u32) -> Floor {
    if occupied == 0 {
        return Floor::Unknown;
    }
    let mut tops = occupied & !(occupied >> 1);
    while tops != 0 {
        let z = tops.trailing_zeros();
        if !(free >> z >> 1) & low_bits(headroom) == 0 {
            return Floor::At(z as u8);
        }
        tops &= tops - 1;
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

    /// Oracle: the definition, voxel by voxel.
    #[test]
    fn the_ground_is_the_lowest_surface_with_headroom() {
        let mut random = Random::new(4);
        let wide = |random: &mut Random| u128::from(random.bits()) << 64 | u128::from(random.bits());
        for round in 0..20_000 {
            let headroom = 1 + (random.bits() % 12) as u32;
            let occupied = wide(&mut random) & wide(&mut random) & wide(&mut random);
            // Mostly free, or there would hardly be headroom.
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

    /// By hand: nobody has looked at the air between a floor at 3 and a ceiling at 60; a wall; a kerb.
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
}
