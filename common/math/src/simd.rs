//! Instruction sets, detected once and chosen at run time.
//!
//! A kernel is written once, as [`Work`] over a trait of vector operations: [`pulp::Simd`], or a trait of its own
//! crate that has an implementation for each instruction set.

use std::sync::LazyLock;

#[cfg(target_arch = "aarch64")]
use pulp::aarch64::Neon;
#[cfg(target_arch = "x86_64")]
use pulp::x86::{V3, V4};
use pulp::{NullaryFnOnce, Scalar};

/// Work with the vectors `S` of an instruction set. `run` and all functions that it calls must be
/// `inline(always)`, or they are compiled for the baseline instruction set.
pub trait Work<S> {
    type Output;
    fn run(self, simd: S) -> Self::Output;
}

macro_rules! portable_work {
    ($($simd:ty),+) => {
        /// [`Work`] for every instruction set of this architecture.
        pub trait PortableWork<T>: $(Work<$simd, Output = T> +)+ {}
        impl<T, W: $(Work<$simd, Output = T> +)+> PortableWork<T> for W {}
    };
}

#[cfg(target_arch = "x86_64")]
portable_work!(Scalar, V3, V4);
#[cfg(target_arch = "aarch64")]
portable_work!(Scalar, Neon);
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
portable_work!(Scalar);

struct Bound<S, W>(S, W);

impl<S, W: Work<S>> NullaryFnOnce for Bound<S, W> {
    type Output = W::Output;

    #[inline(always)]
    fn call(self) -> W::Output {
        self.1.run(self.0)
    }
}

/// An instruction set of this processor, from [`Self::available`]; only [`Self::Portable`] exists without detection.
#[derive(Clone, Copy, Debug)]
pub enum InstructionSet {
    /// Scalar code, for any processor.
    Portable,
    /// AVX2: eight `f32` at once.
    #[cfg(target_arch = "x86_64")]
    Avx2(V3),
    /// AVX-512 with its byte and word extension (BW): sixteen `f32` at once.
    #[cfg(target_arch = "x86_64")]
    Avx512(V4),
    /// NEON: four `f32` at once.
    #[cfg(target_arch = "aarch64")]
    Neon(Neon),
}

static AVAILABLE: LazyLock<Vec<InstructionSet>> = LazyLock::new(|| {
    let mut sets = vec![InstructionSet::Portable];
    #[cfg(target_arch = "x86_64")]
    {
        sets.extend(V3::try_new().map(InstructionSet::Avx2));
        sets.extend(V4::try_new().map(InstructionSet::Avx512));
    }
    #[cfg(target_arch = "aarch64")]
    sets.extend(Neon::try_new().map(InstructionSet::Neon));
    sets
});

impl InstructionSet {
    /// Returns the instruction sets of this processor, narrowest first.
    pub fn available() -> &'static [Self] {
        &AVAILABLE
    }

    pub fn widest() -> Self {
        Self::available().last().copied().unwrap_or(Self::Portable)
    }

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
    pub fn dispatch<T, W: PortableWork<T>>(self, work: W) -> T {
        match self {
            Self::Portable => Work::<Scalar>::run(work, Scalar),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(simd) => simd.vectorize(Bound(simd, work)),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(simd) => simd.vectorize(Bound(simd, work)),
            #[cfg(target_arch = "aarch64")]
            Self::Neon(simd) => simd.vectorize(Bound(simd, work)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Lanes;

    impl<S: pulp::Simd> Work<S> for Lanes {
        type Output = usize;

        #[inline(always)]
        fn run(self, _: S) -> usize {
            S::F32_LANES
        }
    }

    /// Oracle: the standard library's detection, and the register widths.
    #[test]
    fn instruction_sets_are_those_of_the_processor_narrowest_first() {
        #[allow(unused_mut, reason = "other architectures have scalar code only")]
        let mut expected = vec![("portable", 1)];
        #[cfg(target_arch = "x86_64")]
        {
            let is_avx2 = std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma");
            let is_avx512 = is_avx2
                && std::is_x86_feature_detected!("avx512f")
                && std::is_x86_feature_detected!("avx512bw")
                && std::is_x86_feature_detected!("avx512vl")
                && std::is_x86_feature_detected!("avx512dq");
            expected.extend(is_avx2.then_some(("avx2", 8)));
            expected.extend(is_avx512.then_some(("avx512", 16)));
        }
        #[cfg(target_arch = "aarch64")]
        expected.push(("neon", 4));
        let found: Vec<(&str, usize)> =
            InstructionSet::available().iter().map(|set| (set.name(), set.dispatch(Lanes))).collect();
        assert_eq!(found, expected);
        assert_eq!(InstructionSet::widest().name(), expected[expected.len() - 1].0);
    }
}
