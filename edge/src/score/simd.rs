//! The two integer loops that dominate queries, for every supported instruction set.
//!
//! All sums are integers and none can overflow, so every instruction set gives the same bits.

#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(target_arch = "x86_64")]
mod x86;

use pulp::Scalar;
use slag_common::shard::BLOCK;
use slag_math::simd::Work;

/// Vectors are zero-padded to a multiple of this many components, the width of the widest instruction set.
pub const PAD: usize = 32;
/// Rows multiplied at a time, so that their sums are reduced together.
pub const ROWS: usize = 4;

/// One byte column of a block of Gaussians, or the codewords of a subspace for each half of a byte shuffle.
pub type Column = [u8; BLOCK];

pub trait Kernels: Copy {
    /// Returns the products of rows, all of the same length, a multiple of [`PAD`], with a vector.
    fn dots(self, rows: [&[i8]; ROWS], vector: &[i16]) -> [i32; ROWS];

    /// Returns, for each Gaussian of a block, the sum of the values selected by its codes. `low`, `high`: for each
    /// byte column the 16 values of the subspace in the low and in the high half, twice over. With at most 64 columns
    /// no sum exceeds 16 bits.
    fn block_sums(self, columns: &[Column], low: &[Column], high: &[Column]) -> [u16; BLOCK];
}

impl Kernels for Scalar {
    #[inline(always)]
    fn dots(self, rows: [&[i8]; ROWS], vector: &[i16]) -> [i32; ROWS] {
        rows.map(|row| dot(row, vector))
    }

    #[inline(always)]
    fn block_sums(self, columns: &[Column], low: &[Column], high: &[Column]) -> [u16; BLOCK] {
        let mut sums = [0; BLOCK];
        for ((codes, low), high) in columns.iter().zip(low).zip(high) {
            for (sum, code) in sums.iter_mut().zip(codes) {
                *sum += u16::from(low[usize::from(code & 15)]) + u16::from(high[usize::from(code >> 4)]);
            }
        }
        sums
    }
}

/// Returns the product of a row and a vector, which may be longer.
#[inline(always)]
fn dot(row: &[i8], vector: &[i16]) -> i32 {
    row.iter().zip(vector).map(|(a, b)| i32::from(*a) * i32::from(*b)).sum()
}

/// Multiplies rows of a matrix with a vector.
pub struct RowsTimesVector<'a> {
    /// `[n][n_components]`.
    pub rows: &'a [i8],
    pub n_components: usize,
    /// The vector, padded with zeros to the next multiple of [`PAD`].
    pub vector: &'a [i16],
    /// The rows, ascending.
    pub which: &'a [u32],
}

impl<K: Kernels> Work<K> for RowsTimesVector<'_> {
    type Output = Vec<i32>;

    #[inline(always)]
    fn run(self, kernels: K) -> Vec<i32> {
        let Self { rows, n_components, vector, which } = self;
        let mut products = Vec::with_capacity(which.len());
        for which in which.chunks(ROWS) {
            let last = which[which.len() - 1] as usize;
            // Components read past a row's end meet the padding's zeros. The last rows cannot be read past their end.
            if last * n_components + vector.len() <= rows.len() {
                let mut four = [&rows[last * n_components..][..vector.len()]; ROWS];
                for (row, at) in four.iter_mut().zip(which) {
                    *row = &rows[*at as usize * n_components..][..vector.len()];
                }
                products.extend_from_slice(&kernels.dots(four, vector)[..which.len()]);
            } else {
                for at in which {
                    products.push(dot(&rows[*at as usize * n_components..][..n_components], vector));
                }
            }
        }
        products
    }
}

pub struct BlockSums<'a> {
    pub columns: &'a [Column],
    /// Values of the subspaces in the low halves.
    pub low: &'a [Column],
    /// Values of the subspaces in the high halves.
    pub high: &'a [Column],
}

impl<K: Kernels> Work<K> for BlockSums<'_> {
    type Output = [u16; BLOCK];

    #[inline(always)]
    fn run(self, kernels: K) -> [u16; BLOCK] {
        kernels.block_sums(self.columns, self.low, self.high)
    }
}

#[derive(Clone, Debug, Default)]
pub struct LastBlock {
    pub block: Option<usize>,
    pub sums: [u16; BLOCK],
}

/// Finds the Gaussians of a range with code sums at or above a value; returns the number of blocks read.
pub struct FindSums<'a> {
    /// Byte columns of all blocks, see [`Kernels::block_sums`].
    pub columns: &'a [Column],
    /// Values of the subspaces in the low halves.
    pub low: &'a [Column],
    /// Values of the subspaces in the high halves.
    pub high: &'a [Column],
    pub members: std::ops::Range<usize>,
    pub least: u16,
    /// The block in which an earlier range may have ended.
    pub last: &'a mut LastBlock,
    /// Receives Gaussians and their sums, ascending.
    pub found: &'a mut Vec<(u32, u16)>,
}

impl<K: Kernels> Work<K> for FindSums<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self, kernels: K) {
        let Self { columns, low, high, members, least, last, found } = self;
        for block in members.start / BLOCK..members.end.div_ceil(BLOCK) {
            if last.block != Some(block) {
                let columns = &columns[block * low.len()..][..low.len()];
                last.sums = kernels.block_sums(columns, low, high);
                last.block = Some(block);
            }
            let first = block * BLOCK;
            let (start, end) = (members.start.saturating_sub(first), (members.end - first).min(BLOCK));
            // Most blocks hold none: a mask without branches, then its bits.
            let mut reaching = 0u32;
            for (sum, at) in last.sums.iter().zip(0..) {
                reaching |= u32::from(*sum >= least) << at;
            }
            reaching &= (u32::MAX << start) & (u32::MAX >> (BLOCK - end));
            while reaching != 0 {
                let at = reaching.trailing_zeros() as usize;
                reaching &= reaching - 1;
                found.push(((first + at) as u32, last.sums[at]));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_math::random::Random;
    use slag_math::simd::InstructionSet;

    /// Oracle: plain 64-bit sums. Lengths around every width, extreme values, rows that end the matrix and cannot
    /// be read past their end, rows left out.
    #[test]
    fn products_are_the_sums_with_every_instruction_set() {
        let mut random = Random::new(11);
        for n_components in (1..70usize).chain([96, 100, 511, 512, 513, 8192]) {
            for n_rows in [0, 1, 3, 4, 5, 37] {
                let is_extreme = n_rows == 5;
                let rows: Vec<i8> = (0..n_rows * n_components)
                    .map(|_| if is_extreme { -128 } else { random.bits() as i8 })
                    .collect();
                // The largest value that the bound on absolute sums allows, see `Rounded`.
                let most = ((1 << 24) / n_components as i64 - 1).clamp(1, 32767);
                let mut vector: Vec<i16> = (0..n_components)
                    .map(|_| if is_extreme { -most } else { random.bits() as i64 % (most + 1) } as i16)
                    .collect();
                vector.resize(n_components.next_multiple_of(PAD), 0);
                let exact = |row: &[i8]| -> i64 {
                    row.iter().zip(&vector).map(|(a, b)| i64::from(*a) * i64::from(*b)).sum()
                };
                let all: Vec<u32> = (0..n_rows as u32).collect();
                let odd: Vec<u32> = (1..n_rows as u32).step_by(2).collect();
                for which in [&all[..], &odd, &all[n_rows.saturating_sub(1)..]] {
                    let row = |at: &u32| exact(&rows[*at as usize * n_components..][..n_components]);
                    let expected: Vec<i64> = which.iter().map(row).collect();
                    for set in InstructionSet::available() {
                        let work = RowsTimesVector { rows: &rows, n_components, vector: &vector, which };
                        let found: Vec<i64> = set.dispatch(work).into_iter().map(i64::from).collect();
                        assert_eq!(found, expected, "{} {n_components} {which:?}", set.name());
                    }
                }
            }
        }
    }

    /// Oracle: each code looked up individually. Up to 64 columns of 255, the most that 16 bits must hold.
    #[test]
    fn sums_of_a_block_are_the_looked_up_values_with_every_instruction_set() {
        let mut random = Random::new(12);
        for n_columns in (0..20).chain([63, 64]) {
            for highest in [1, 255] {
                let mut bytes = |most: u64| -> Vec<u8> {
                    let byte = |_| if most == 1 { 255 } else { (random.bits() % (most + 1)) as u8 };
                    (0..n_columns * BLOCK).map(byte).collect()
                };
                let columns = bytes(255);
                let [low, high] = [0; 2].map(|_| {
                    let codewords = bytes(highest);
                    let twice = |codewords: &[u8]| [&codewords[..16], &codewords[..16]].concat();
                    codewords.chunks_exact(BLOCK).flat_map(twice).collect::<Vec<u8>>()
                });
                let expected: Vec<u64> = (0..BLOCK)
                    .map(|at| {
                        let value = |column: usize| {
                            let code = columns[column * BLOCK + at];
                            let (l, h) = (usize::from(code % 16), usize::from(code / 16));
                            u64::from(low[column * BLOCK + l]) + u64::from(high[column * BLOCK + h])
                        };
                        (0..n_columns).map(value).sum()
                    })
                    .collect();
                let [columns, low, high] = [&columns, &low, &high].map(|c| c.as_chunks::<BLOCK>().0);
                for set in InstructionSet::available() {
                    let found = set.dispatch(BlockSums { columns, low, high });
                    assert_eq!(found.map(u64::from).to_vec(), expected, "{} {n_columns}", set.name());
                }
            }
        }
    }

    /// Oracle: one comparison per sum, at both ends of 16 bits and around the sign bit.
    #[test]
    fn sums_that_reach_a_value_are_found_with_every_instruction_set() {
        let mut random = Random::new(13);
        const N_COLUMNS: usize = 64;
        let n_blocks = 5;
        let columns: Vec<Column> =
            (0..n_blocks * N_COLUMNS).map(|_| [(); BLOCK].map(|()| random.bits() as u8)).collect();
        for highest in [3u64, 256] {
            let mut table = || -> Vec<Column> {
                let codewords = |_| {
                    let codewords: [u8; 16] = [(); 16].map(|()| (random.bits() % highest) as u8);
                    std::array::from_fn(|at| codewords[at % 16])
                };
                (0..N_COLUMNS).map(codewords).collect()
            };
            let (low, high) = (table(), table());
            let sums: Vec<u16> = columns
                .chunks_exact(N_COLUMNS)
                .flat_map(|block| Scalar.block_sums(block, &low, &high))
                .collect();
            let (least_sum, most) = (sums.iter().min().copied(), sums.iter().max().copied());
            for least in [Some(0), Some(u16::MAX), Some(0x8000), least_sum, most, Some(sums[40])] {
                let least = least.expect("there are sums");
                for set in InstructionSet::available() {
                    let (mut last, mut found) = (LastBlock::default(), Vec::new());
                    let ends = [0, 1, 31, 32, 33, 96, 97, 98, 160];
                    for ends in ends.windows(2) {
                        let (columns, members) = (&columns[..], ends[0]..ends[1]);
                        let (last, found, low, high) = (&mut last, &mut found, &low[..], &high[..]);
                        set.dispatch(FindSums { columns, low, high, members, least, last, found });
                    }
                    let expected: Vec<(u32, u16)> =
                        (0..).zip(sums.iter().copied()).filter(|(_, sum)| *sum >= least).collect();
                    assert_eq!(found, expected, "{} {least}", set.name());
                }
            }
        }
    }
}
