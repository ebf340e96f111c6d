//! Vector operations of the rasteriser that `pulp` lacks.

use bytemuck::{cast, cast_slice_mut};
use pulp::{Scalar, Simd};
#[cfg(target_arch = "aarch64")]
use pulp::{aarch64::Neon, f32x4, f64x2};
#[cfg(target_arch = "x86_64")]
use pulp::{
    f32x4, f32x8, f32x16, f64x4, f64x8,
    x86::{V3, V4},
};

/// [`Simd`] with a widening addition. All instruction sets give the same bits: multiply-adds are not fused, and
/// reordered sums are exact.
pub trait Lanes: Simd {
    /// Adds each value, widened to `f64`, to the sum of its lane.
    fn add_to_f64(self, values: Self::f32s, sums: &mut [f64]);
}

impl Lanes for Scalar {
    #[inline(always)]
    fn add_to_f64(self, value: f32, sums: &mut [f64]) {
        sums[0] += f64::from(value);
    }
}

#[cfg(target_arch = "x86_64")]
impl Lanes for V3 {
    #[inline(always)]
    fn add_to_f64(self, values: f32x8, sums: &mut [f64]) {
        let [low, high]: [f32x4; 2] = cast(values);
        let sums = cast_slice_mut::<f64, f64x4>(sums);
        sums[0] = self.add_f64x4(sums[0], self.convert_f32x4_to_f64x4(low));
        sums[1] = self.add_f64x4(sums[1], self.convert_f32x4_to_f64x4(high));
    }
}

#[cfg(target_arch = "x86_64")]
impl Lanes for V4 {
    #[inline(always)]
    fn add_to_f64(self, values: f32x16, sums: &mut [f64]) {
        let [low, high]: [f32x8; 2] = cast(values);
        let sums = cast_slice_mut::<f64, f64x8>(sums);
        sums[0] = self.add_f64x8(sums[0], self.convert_f32x8_to_f64x8(low));
        sums[1] = self.add_f64x8(sums[1], self.convert_f32x8_to_f64x8(high));
    }
}

#[cfg(target_arch = "aarch64")]
impl Lanes for Neon {
    #[inline(always)]
    fn add_to_f64(self, values: f32x4, sums: &mut [f64]) {
        let values: std::arch::aarch64::float32x4_t = cast(values);
        let low = cast(self.neon.vcvt_f64_f32(self.neon.vget_low_f32(values)));
        let high = cast(self.neon.vcvt_high_f64_f32(values));
        let sums = cast_slice_mut::<f64, f64x2>(sums);
        sums[0] = self.add_f64s(sums[0], low);
        sums[1] = self.add_f64s(sums[1], high);
    }
}
