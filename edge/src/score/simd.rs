//! The two integer loops that queries spend their time in, for every instruction set there is.
//!
//! All sums are of integers and none can overflow, so that every level gives the same bits.

#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(target_arch = "x86_64")]
mod x86;

use pulp::NullaryFnOnce;
#[cfg(target_arch = "aarch64")]
use pulp::aarch64::Neon;
#[cfg(target_arch = "x86_64")]
use pulp::x86::{V3, V4};
use slag_common::shard::BLOCK;

/// Vectors are padded with zeros to a multiple of this many components: what the widest level multiplies
/// at once.
pub const PAD: usize = 32;
/// Rows that are multiplied together, so that their sums are folded together.
pub const ROWS: usize = 4;

/// One byte column of a block of Gaussians, or the codewords of a group for each half of a byte shuffle.
pub type Column = [u8; BLOCK];

/// What an instruction set does.
pub trait Kernels: Copy {
    /// Returns the products of centroids with a vector. All have the same length, a multiple of [`PAD`].
    fn dots(self, centroids: [&[i8]; ROWS], vector: &[i16]) -> [i32; ROWS];

    /// Returns for each Gaussian of a block the sum of the values that its codes name. `low`, `high`: for
    /// each byte column the 16 values of the group in the low and in the high half, twice over.
    /// There are at most 64 columns, so that no sum exceeds 16 bits.
    fn block_sums(self, columns: &[Column], low: &[Column], high: &[Column]) -> [u16; BLOCK];

    /// Returns a bit for each of a block's sums, from the lowest bit up: whether it is at least `least`.
    fn at_least(self, sums: &[u16; BLOCK], least: u16) -> u32;
}

/// Plain code, for any processor.
#[derive(Clone, Copy, Debug)]
pub struct Portable;

impl Kernels for Portable {
    #[inline(always)]
    fn dots(self, centroids: [&[i8]; ROWS], vector: &[i16]) -> [i32; ROWS] {
        centroids.map(|centroid| dot(centroid, vector))
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

    #[inline(always)]
    fn at_least(self, sums: &[u16; BLOCK], least: u16) -> u32 {
        let bits = sums.iter().zip(0..).map(|(sum, at)| u32::from(*sum >= least) << at);
        bits.fold(0, |mask, bit| mask | bit)
    }
}

/// Returns the product of a centroid and a vector, which may be longer.
#[inline(always)]
fn dot(centroid: &[i8], vector: &[i16]) -> i32 {
    centroid.iter().zip(vector).map(|(a, b)| i32::from(*a) * i32::from(*b)).sum()
}

/// Work that is written once for all instruction sets; its `run` and all that it calls must be
/// `inline(always)`, or it is compiled for the plain processor.
pub trait Work {
    /// What it gives.
    type Output;
    /// Does the work.
    fn run<K: Kernels>(self, kernels: K) -> Self::Output;
}

/// Work on an instruction set that is known.
struct On<K, W>(K, W);

impl<K: Kernels, W: Work> NullaryFnOnce for On<K, W> {
    type Output = W::Output;

    #[inline(always)]
    fn call(self) -> W::Output {
        self.1.run(self.0)
    }
}

/// An instruction set that this processor has.
#[derive(Clone, Copy, Debug)]
pub enum Level {
    /// Plain code.
    Portable,
    /// AVX2.
    #[cfg(target_arch = "x86_64")]
    Avx2(V3),
    /// AVX-512, with bytes and codewords.
    #[cfg(target_arch = "x86_64")]
    Avx512(V4),
    /// NEON.
    #[cfg(target_arch = "aarch64")]
    Neon(Neon),
}

impl Level {
    /// Returns those that this processor has, narrowest first.
    pub fn available() -> Vec<Self> {
        let mut levels = vec![Self::Portable];
        #[cfg(target_arch = "x86_64")]
        {
            levels.extend(V3::try_new().map(Self::Avx2));
            levels.extend(V4::try_new().map(Self::Avx512));
        }
        #[cfg(target_arch = "aarch64")]
        levels.extend(Neon::try_new().map(Self::Neon));
        levels
    }

    /// Returns the widest that this processor has.
    pub fn widest() -> Self {
        Self::available().pop().unwrap_or(Self::Portable)
    }

    /// Returns the name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(_) => "avx2",
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => "avx512",
            #[cfg(target_arch = "aarch64")]
            Self::Neon(_) => "neon",
        }
    }

    /// Does work compiled for this instruction set.
    pub fn dispatch<W: Work>(self, work: W) -> W::Output {
        match self {
            Self::Portable => work.run(Portable),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(simd) => pulp::Simd::vectorize(simd, On(simd, work)),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(simd) => pulp::Simd::vectorize(simd, On(simd, work)),
            #[cfg(target_arch = "aarch64")]
            Self::Neon(simd) => pulp::Simd::vectorize(simd, On(simd, work)),
        }
    }
}

/// Multiplies every centroid of a matrix with a vector; gives products in the order of the centroids.
pub struct MatrixTimesVector<'a, F> {
    /// `[n][n_components]`.
    pub centroids: &'a [i8],
    /// Components of a centroid.
    pub n_components: usize,
    /// The vector, padded with zeros to the next multiple of [`PAD`].
    pub vector: &'a [i16],
    /// Called with the place of a centroid and its product.
    pub put: F,
}

impl<F: FnMut(usize, i32)> Work for MatrixTimesVector<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run<K: Kernels>(self, kernels: K) {
        let Self { centroids, n_components, vector, mut put } = self;
        // Rows of nothing have no products, and nothing tells how many there are.
        let Some(n_centroids) = centroids.len().checked_div(n_components) else { return };
        // What a centroid is read beyond its end is multiplied with the padding's zeros; the last centroids cannot be.
        let n_padded = (centroids.len() + n_components).saturating_sub(vector.len()) / n_components;
        let n_together = n_padded.min(n_centroids) / ROWS * ROWS;
        for at in (0..n_together).step_by(ROWS) {
            let start = at * n_components;
            let four = &centroids[start..start + (ROWS - 1) * n_components + vector.len()];
            let (a, b) = (&four[..vector.len()], &four[n_components..][..vector.len()]);
            let (c, d) = (&four[2 * n_components..][..vector.len()], &four[3 * n_components..]);
            let dots = kernels.dots([a, b, c, d], vector);
            for (centroid, dot) in (at..).zip(dots) {
                put(centroid, dot);
            }
        }
        for centroid in n_together..n_centroids {
            put(centroid, dot(&centroids[centroid * n_components..][..n_components], vector));
        }
    }
}

/// Sums the values of a block's codes, see [`Kernels::block_sums`].
pub struct BlockSums<'a> {
    /// Byte columns of the block.
    pub columns: &'a [Column],
    /// Values of the groups in the low halves.
    pub low: &'a [Column],
    /// Values of the groups in the high halves.
    pub high: &'a [Column],
}

impl Work for BlockSums<'_> {
    type Output = [u16; BLOCK];

    #[inline(always)]
    fn run<K: Kernels>(self, kernels: K) -> [u16; BLOCK] {
        kernels.block_sums(self.columns, self.low, self.high)
    }
}

/// The sums of the block that was read last.
#[derive(Clone, Debug, Default)]
pub struct LastBlock {
    /// Which it was.
    pub block: Option<usize>,
    /// Its sums.
    pub sums: [u16; BLOCK],
}

/// Finds the Gaussians of a range whose codes' sums reach a value; returns the number of blocks read.
pub struct FindSums<'a> {
    /// Byte columns of all blocks, see [`Kernels::block_sums`].
    pub columns: &'a [Column],
    /// Values of the groups in the low halves.
    pub low: &'a [Column],
    /// Values of the groups in the high halves.
    pub high: &'a [Column],
    /// Which Gaussians.
    pub members: std::ops::Range<usize>,
    /// What sums are compared with.
    pub least: u16,
    /// Where an earlier range may have ended.
    pub last: &'a mut LastBlock,
    /// Gets Gaussians and their sums, ascending.
    pub found: &'a mut Vec<(u32, u16)>,
}

impl Work for FindSums<'_> {
    type Output = u64;

    #[inline(always)]
    fn run<K: Kernels>(self, kernels: K) -> u64 {
        let Self { columns, low, high, members, least, last, found } = self;
        let mut n_read = 0;
        for block in members.start / BLOCK..members.end.div_ceil(BLOCK) {
            if last.block != Some(block) {
                let columns = &columns[block * low.len()..][..low.len()];
                last.sums = kernels.block_sums(columns, low, high);
                last.block = Some(block);
                n_read += 1;
            }
            let first = block * BLOCK;
            let (start, end) = (members.start.saturating_sub(first), (members.end - first).min(BLOCK));
            let of_range = (u32::MAX << start) & (u32::MAX >> (BLOCK - end));
            let mut reaching = of_range & kernels.at_least(&last.sums, least);
            while reaching != 0 {
                let at = reaching.trailing_zeros() as usize;
                reaching &= reaching - 1;
                found.push(((first + at) as u32, last.sums[at]));
            }
        }
        n_read
    }
}

/// Multiplies some centroids of a matrix with a vector.
pub struct SomeRowsTimesVector<'a> {
    /// `[n][n_components]`.
    pub centroids: &'a [i8],
    /// Components of a centroid, not 0.
    pub n_components: usize,
    /// The vector, padded with zeros to the next multiple of [`PAD`].
    pub vector: &'a [i16],
    /// Which centroids, ascending.
    pub which: &'a [u32],
    /// Gets their products.
    pub products: &'a mut Vec<i32>,
}

impl Work for SomeRowsTimesVector<'_> {
    type Output = ();

    #[inline(always)]
    fn run<K: Kernels>(self, kernels: K) {
        let Self { centroids, n_components, vector, which, products } = self;
        products.clear();
        for which in which.chunks(ROWS) {
            let last = which[which.len() - 1] as usize;
            // As for all centroids: what is read beyond a centroid's end is multiplied with zeros.
            if last * n_components + vector.len() <= centroids.len() {
                let mut four = [&centroids[last * n_components..][..vector.len()]; ROWS];
                for (centroid, at) in four.iter_mut().zip(which) {
                    *centroid = &centroids[*at as usize * n_components..][..vector.len()];
                }
                products.extend_from_slice(&kernels.dots(four, vector)[..which.len()]);
            } else {
                for at in which {
                    products.push(dot(&centroids[*at as usize * n_components..][..n_components], vector));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_math::random::Random;

    /// Oracle: plain 64-bit sums. Lengths around every width, values at both ends, and the last centroids, which
    /// cannot be read past their end.
    #[test]
    fn products_are_the_sums_at_every_level() {
        let mut random = Random::new(11);
        for n_components in (1..70usize).chain([96, 100, 511, 512, 513, 8192]) {
            for n_centroids in [0, 1, 3, 4, 5, 37] {
                let is_extreme = n_centroids == 5;
                let centroids: Vec<i8> = (0..n_centroids * n_components)
                    .map(|_| if is_extreme { -128 } else { random.bits() as i8 })
                    .collect();
                // The largest that the sum of absolute values allows, see `rounded`.
                let most = ((1 << 24) / n_components as i64 - 1).clamp(1, 32767);
                let mut vector: Vec<i16> = (0..n_components)
                    .map(|_| if is_extreme { -most } else { random.bits() as i64 % (most + 1) } as i16)
                    .collect();
                vector.resize(n_components.next_multiple_of(PAD), 0);
                let exact = |centroid: &[i8]| -> i64 {
                    centroid.iter().zip(&vector).map(|(a, b)| i64::from(*a) * i64::from(*b)).sum()
                };
                let expected: Vec<i64> = centroids.chunks_exact(n_components).map(exact).collect();
                for level in Level::available() {
                    let mut found = Vec::new();
                    let put = |centroid: usize, dot: i32| {
                        assert_eq!(centroid, found.len());
                        found.push(i64::from(dot));
                    };
                    level.dispatch(MatrixTimesVector {
                        centroids: &centroids,
                        n_components,
                        vector: &vector,
                        put,
                    });
                    assert_eq!(found, expected, "{} {n_components} {n_centroids}", level.name());
                }
            }
        }
    }

    /// Oracle: each code looked up by itself. Up to 64 columns of 255, the most that 16 bits must hold.
    #[test]
    fn sums_of_a_block_are_the_looked_up_values_at_every_level() {
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
                for level in Level::available() {
                    let found = level.dispatch(BlockSums { columns, low, high });
                    assert_eq!(found.map(u64::from).to_vec(), expected, "{} {n_columns}", level.name());
                }
            }
        }
    }

    /// Oracle: one comparison for each sum, at both ends of 16 bits and around the sign. The codewords of code 1 make
    /// a sum of what its columns say.
    #[test]
    fn sums_that_reach_a_value_are_found_at_every_level() {
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
                .flat_map(|block| Portable.block_sums(block, &low, &high))
                .collect();
            let (least_sum, most) = (sums.iter().min().copied(), sums.iter().max().copied());
            for least in [Some(0), Some(u16::MAX), Some(0x8000), least_sum, most, Some(sums[40])] {
                let least = least.expect("there are sums");
                for level in Level::available() {
                    let (mut last, mut found, mut n_read) = (LastBlock::default(), Vec::new(), 0);
                    let ends = [0, 1, 31, 32, 33, 96, 97, 98, 160];
                    for ends in ends.windows(2) {
                        let (columns, members) = (&columns[..], ends[0]..ends[1]);
                        let (last, found, low, high) = (&mut last, &mut found, &low[..], &high[..]);
                        n_read +=
                            level.dispatch(FindSums { columns, low, high, members, least, last, found });
                    }
                    let expected: Vec<(u32, u16)> =
                        (0..).zip(sums.iter().copied()).filter(|(_, sum)| *sum >= least).collect();
                    assert_eq!(found, expected, "{} {least}", level.name());
                    assert_eq!(n_read, n_blocks as u64);
                }
            }
        }
    }

    /// Oracle: plain sums; the last centroids cannot be read past their end.
    #[test]
    fn products_of_some_rows_are_the_sums_at_every_level() {
        let mut random = Random::new(14);
        for n_components in [1usize, 2, 31, 32, 33, 96, 126, 512] {
            let centroids: Vec<i8> = (0..40 * n_components).map(|_| random.bits() as i8).collect();
            let mut vector: Vec<i16> =
                (0..n_components).map(|_| (random.bits() % 999) as i16 - 500).collect();
            vector.resize(n_components.next_multiple_of(PAD), 0);
            for which in [vec![], vec![39], vec![0, 3, 4, 17, 38], (0..40).collect::<Vec<u32>>()] {
                let expected: Vec<i32> = which
                    .iter()
                    .map(|at| dot(&centroids[*at as usize * n_components..][..n_components], &vector))
                    .collect();
                for level in Level::available() {
                    let mut products = vec![7];
                    let (centroids, vector, which) = (&centroids[..], &vector[..], &which[..]);
                    let products_of = SomeRowsTimesVector {
                        centroids,
                        n_components,
                        vector,
                        which,
                        products: &mut products,
                    };
                    level.dispatch(products_of);
                    assert_eq!(products, expected, "{} {n_components}", level.name());
                }
            }
        }
    }
}
