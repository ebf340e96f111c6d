//! 128 bits for a descriptor: the signs of its components along learned directions (Gong et al. 2013, iterative
//! quantisation). Two descriptors are as alike as their bits.

use crate::describe::{DIM, Descriptor};

pub type Code = u128;

/// Version of the codes: maps of other versions cannot be matched.
pub const CODE_VERSION: u32 = 1;

/// `[DIM]` the mean of descriptors, u8 in 1/1000, then `[128][DIM]` the directions, i8, of any length. Learned from
/// the features of two scenes (`train_codes.py`).
static LEARNED: &[u8; DIM + 128 * DIM] = include_bytes!("codes-1.bin");
const MEAN_STEP: f32 = 1e-3;

pub fn code(descriptor: &Descriptor) -> Code {
    let (mean, directions) = LEARNED.split_at(DIM);
    let mut centred = *descriptor;
    centred.iter_mut().zip(mean).for_each(|(v, m)| *v -= f32::from(*m) * MEAN_STEP);
    let bit = |direction: &[u8]| {
        let mut along = [0.0; DIM];
        along.iter_mut().zip(direction).for_each(|(a, d)| *a = f32::from(*d as i8));
        u128::from(slag_math::dot(&along, &centred) > 0.0)
    };
    directions.chunks_exact(DIM).enumerate().map(|(at, direction)| bit(direction) << at).sum()
}

/// Returns the number of bits in which two codes differ.
pub fn distance(a: Code, b: Code) -> u32 {
    (a ^ b).count_ones()
}
