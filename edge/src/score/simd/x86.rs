//! AVX2 and AVX-512 kernels. Loops only: closures would be compiled for the baseline processor.

use std::arch::x86_64::{__m128i, __m256i, __m512i};

use bytemuck::cast;
use pulp::x86::{V3, V4};
use slag_common::shard::BLOCK;

use super::{Column, Kernels, ROWS};

impl Kernels for V3 {
    #[inline(always)]
    fn dots(self, rows: [&[i8]; ROWS], vector: &[i16]) -> [i32; ROWS] {
        let (avx, avx2) = (self.avx, self.avx2);
        let [a, b, c, d] = rows;
        let (a, b) = (a.as_chunks::<16>().0, b.as_chunks::<16>().0);
        let (c, d) = (c.as_chunks::<16>().0, d.as_chunks::<16>().0);
        let vector = vector.as_chunks::<16>().0;
        let mut sums = [avx._mm256_setzero_si256(); ROWS];
        for ((((a, b), c), d), vector) in a.iter().zip(b).zip(c).zip(d).zip(vector) {
            let vector: __m256i = cast(*vector);
            for (sum, row) in sums.iter_mut().zip([a, b, c, d]) {
                let products = avx2._mm256_madd_epi16(avx2._mm256_cvtepi8_epi16(cast(*row)), vector);
                *sum = avx2._mm256_add_epi32(*sum, products);
            }
        }
        fold(self, sums)
    }

    #[inline(always)]
    fn block_sums(self, columns: &[Column], low: &[Column], high: &[Column]) -> [u16; BLOCK] {
        let mut sums = [self.avx._mm256_setzero_si256(); 2];
        for ((codes, low), high) in columns.iter().zip(low).zip(high) {
            add_column(self, &mut sums, codes, low, high);
        }
        in_order(self, sums)
    }
}

impl Kernels for V4 {
    #[inline(always)]
    fn dots(self, rows: [&[i8]; ROWS], vector: &[i16]) -> [i32; ROWS] {
        let (avx512f, avx512bw) = (self.avx512f, self.avx512bw);
        let [a, b, c, d] = rows;
        let (a, b) = (a.as_chunks::<32>().0, b.as_chunks::<32>().0);
        let (c, d) = (c.as_chunks::<32>().0, d.as_chunks::<32>().0);
        let vector = vector.as_chunks::<32>().0;
        let mut sums = [avx512f._mm512_setzero_si512(); ROWS];
        for ((((a, b), c), d), vector) in a.iter().zip(b).zip(c).zip(d).zip(vector) {
            let vector: __m512i = cast(*vector);
            for (sum, row) in sums.iter_mut().zip([a, b, c, d]) {
                let products = avx512bw._mm512_madd_epi16(avx512bw._mm512_cvtepi8_epi16(cast(*row)), vector);
                *sum = avx512f._mm512_add_epi32(*sum, products);
            }
        }
        let [a, b, c, d] = sums;
        let sums = [
            halves_added_32(self, a),
            halves_added_32(self, b),
            halves_added_32(self, c),
            halves_added_32(self, d),
        ];
        fold(*self, sums)
    }

    /// Sums two columns at once, one in each half of a register.
    #[inline(always)]
    fn block_sums(self, columns: &[Column], low: &[Column], high: &[Column]) -> [u16; BLOCK] {
        let (avx512f, avx512bw) = (self.avx512f, self.avx512bw);
        let nibble = avx512f._mm512_set1_epi8(15);
        let mut wide = [avx512f._mm512_setzero_si512(); 2];
        let (pairs, single) = columns.as_chunks::<2>();
        let (low_pairs, high_pairs) = (low.as_chunks::<2>().0, high.as_chunks::<2>().0);
        for ((codes, low), high) in pairs.iter().zip(low_pairs).zip(high_pairs) {
            let codes: __m512i = cast(*codes);
            let in_low = avx512f._mm512_and_si512(codes, nibble);
            let in_high = avx512f._mm512_and_si512(avx512bw._mm512_srli_epi16::<4>(codes), nibble);
            for (table, at) in [(low, in_low), (high, in_high)] {
                let values = avx512bw._mm512_shuffle_epi8(cast(*table), at);
                wide[0] = avx512bw._mm512_add_epi16(wide[0], values);
                wide[1] = avx512bw._mm512_add_epi16(wide[1], avx512bw._mm512_srli_epi16::<8>(values));
            }
        }
        let mut sums = [halves_added_16(self, wide[0]), halves_added_16(self, wide[1])];
        let rest = columns.len() - single.len();
        for ((codes, low), high) in single.iter().zip(&low[rest..]).zip(&high[rest..]) {
            add_column(*self, &mut sums, codes, low, high);
        }
        in_order(*self, sums)
    }
}

#[inline(always)]
fn halves_added_32(simd: V4, value: __m512i) -> __m256i {
    let high = simd.avx512f._mm512_extracti64x4_epi64::<1>(value);
    simd.avx2._mm256_add_epi32(simd.avx512f._mm512_castsi512_si256(value), high)
}

#[inline(always)]
fn halves_added_16(simd: V4, value: __m512i) -> __m256i {
    let high = simd.avx512f._mm512_extracti64x4_epi64::<1>(value);
    simd.avx2._mm256_add_epi16(simd.avx512f._mm512_castsi512_si256(value), high)
}

/// Returns the sum of each register's eight lanes.
#[inline(always)]
fn fold(simd: V3, [a, b, c, d]: [__m256i; ROWS]) -> [i32; ROWS] {
    let avx2 = simd.avx2;
    let four = avx2._mm256_hadd_epi32(avx2._mm256_hadd_epi32(a, b), avx2._mm256_hadd_epi32(c, d));
    let [low, high]: [__m128i; 2] = cast(four);
    cast(simd.sse2._mm_add_epi32(low, high))
}

/// Adds a column's values. `sums[1]` holds those of the odd bytes; `sums[0]` those of the even bytes plus 256 times
/// those of the odd ones. Separating them once at the end is cheaper.
#[inline(always)]
fn add_column(simd: V3, sums: &mut [__m256i; 2], codes: &Column, low: &Column, high: &Column) {
    let avx2 = simd.avx2;
    let nibble = simd.avx._mm256_set1_epi8(15);
    let codes: __m256i = cast(*codes);
    let in_low = avx2._mm256_and_si256(codes, nibble);
    let in_high = avx2._mm256_and_si256(avx2._mm256_srli_epi16::<4>(codes), nibble);
    for (table, at) in [(low, in_low), (high, in_high)] {
        let values = avx2._mm256_shuffle_epi8(cast(*table), at);
        sums[0] = avx2._mm256_add_epi16(sums[0], values);
        sums[1] = avx2._mm256_add_epi16(sums[1], avx2._mm256_srli_epi16::<8>(values));
    }
}

/// Returns the sums that [`add_column`] accumulates, in the order of the Gaussians.
#[inline(always)]
fn in_order(simd: V3, [both, odd]: [__m256i; 2]) -> [u16; BLOCK] {
    let avx2 = simd.avx2;
    let even = avx2._mm256_sub_epi16(both, avx2._mm256_slli_epi16::<8>(odd));
    // Interleaving works within 128 bits.
    let [a, c]: [[u16; 8]; 2] = cast(avx2._mm256_unpacklo_epi16(even, odd));
    let [b, d]: [[u16; 8]; 2] = cast(avx2._mm256_unpackhi_epi16(even, odd));
    cast([a, b, c, d])
}
