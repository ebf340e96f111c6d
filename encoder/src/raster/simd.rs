//! SIMD instruction sets for the arithmetic of pixels.

use bytemuck::{cast, cast_slice_mut};
use pulp::{NullaryFnOnce, Scalar, Simd};
#[cfg(target_arch = "aarch64")]
use pulp::{aarch64::Neon, f32x4, f64x2};
#[cfg(target_arch = "x86_64")]
use pulp::{
    f32x4, f32x8, f32x16, f64x4, f64x8,
    x86::{V3, V4},
};

/// Vector operations of an instruction set: those of [`Simd`], and a widening addition.
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

/// Work that is written once for all instruction sets.
///
/// `run` and all functions that it calls must be `inline(always)`; otherwise they are compiled for the baseline
/// instruction set.
pub trait Work {
    /// Result of the work.
    type Output;
    /// Does the work.
    fn run<S: Lanes>(self, simd: S) -> Self::Output;
}

/// Work on the vectors of one instruction set.
struct On<S, W>(S, W);

impl<S: Lanes, W: Work> NullaryFnOnce for On<S, W> {
    type Output = W::Output;

    #[inline(always)]
    fn call(self) -> W::Output {
        self.1.run(self.0)
    }
}

/// An instruction set of this processor. All give the same bits: multiply-adds are not fused, and sums with another
/// order are exact.
#[derive(Clone, Copy, Debug)]
pub enum Level {
    /// Scalar code, for any processor.
    Portable,
    /// AVX2, eight `f32` at once.
    #[cfg(target_arch = "x86_64")]
    Avx2(V3),
    /// AVX-512, sixteen `f32` at once.
    #[cfg(target_arch = "x86_64")]
    Avx512(V4),
    /// NEON, four `f32` at once.
    #[cfg(target_arch = "aarch64")]
    Neon(Neon),
}

impl Level {
    /// Returns the instruction sets of this processor, narrowest first.
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

    /// Returns the widest instruction set of this processor.
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

    /// Runs work compiled for this instruction set.
    pub fn dispatch<W: Work>(self, work: W) -> W::Output {
        match self {
            Self::Portable => work.run(Scalar),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(simd) => simd.vectorize(On(simd, work)),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(simd) => simd.vectorize(On(simd, work)),
            #[cfg(target_arch = "aarch64")]
            Self::Neon(simd) => simd.vectorize(On(simd, work)),
        }
    }
}
