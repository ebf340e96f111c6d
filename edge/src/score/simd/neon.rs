//! NEON kernels. Loops only: closures would be compiled for the baseline processor.

use std::arch::aarch64::{int8x16_t, int16x8_t, uint8x16_t};

use bytemuck::cast;
use pulp::aarch64::Neon;
use slag_common::shard::BLOCK;

use super::{Column, Kernels, ROWS};

impl Kernels for Neon {
    #[inline(always)]
    fn dots(self, rows: [&[i8]; ROWS], vector: &[i16]) -> [i32; ROWS] {
        let neon = self.neon;
        let [a, b, c, d] = rows;
        let (a, b) = (a.as_chunks::<16>().0, b.as_chunks::<16>().0);
        let (c, d) = (c.as_chunks::<16>().0, d.as_chunks::<16>().0);
        let vector = vector.as_chunks::<16>().0;
        let mut sums = [neon.vdupq_n_s32(0); ROWS];
        for ((((a, b), c), d), vector) in a.iter().zip(b).zip(c).zip(d).zip(vector) {
            let [low, high]: [int16x8_t; 2] = cast(*vector);
            for (sum, row) in sums.iter_mut().zip([a, b, c, d]) {
                let row: int8x16_t = cast(*row);
                for (row, vector) in
                    [(neon.vmovl_s8(neon.vget_low_s8(row)), low), (neon.vmovl_high_s8(row), high)]
                {
                    *sum = neon.vmlal_s16(*sum, neon.vget_low_s16(row), neon.vget_low_s16(vector));
                    *sum = neon.vmlal_high_s16(*sum, row, vector);
                }
            }
        }
        let [a, b, c, d] = sums;
        cast(neon.vpaddq_s32(neon.vpaddq_s32(a, b), neon.vpaddq_s32(c, d)))
    }

    #[inline(always)]
    fn block_sums(self, columns: &[Column], low: &[Column], high: &[Column]) -> [u16; BLOCK] {
        let neon = self.neon;
        let nibble = neon.vdupq_n_u8(15);
        let mut sums = [neon.vdupq_n_u16(0); 4];
        for ((codes, low), high) in columns.iter().zip(low).zip(high) {
            let [low, _]: [uint8x16_t; 2] = cast(*low);
            let [high, _]: [uint8x16_t; 2] = cast(*high);
            for (codes, sums) in
                cast::<_, [uint8x16_t; 2]>(*codes).into_iter().zip(sums.as_chunks_mut::<2>().0)
            {
                let of_low = neon.vqtbl1q_u8(low, neon.vandq_u8(codes, nibble));
                let of_high = neon.vqtbl1q_u8(high, neon.vshrq_n_u8::<4>(codes));
                for values in [of_low, of_high] {
                    sums[0] = neon.vaddw_u8(sums[0], neon.vget_low_u8(values));
                    sums[1] = neon.vaddw_high_u8(sums[1], values);
                }
            }
        }
        cast(sums)
    }
}
