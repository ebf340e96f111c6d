//! The columns to read, and for how many Gaussians.

use std::fmt::Display;
use std::path::Path;

use super::error::SplatError;
use crate::Gaussians;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReadOptions {
    /// Whether to read spherical harmonics above degree 0; otherwise they are never held in memory.
    pub with_sh_rest: bool,
}

impl ReadOptions {
    pub(super) fn kept_degree(self, degree: u8) -> u8 {
        if self.with_sh_rest { degree.min(MAX_SH_DEGREE) } else { 0 }
    }
}

/// Highest degree of spherical harmonics that [`Gaussians`] holds.
pub(super) const MAX_SH_DEGREE: u8 = 3;

/// Largest ratio of decoded to compressed size accepted; a larger one means a wrong count. Trained scenes take at
/// least 8 bytes a Gaussian even as SPZ or SOG (measured: 14 and 25) and decode to 68 bytes, or 248 with all
/// harmonics: a ratio of 31 at most.
const MAX_EXPANSION: u64 = 32;
/// Decoded bytes accepted beyond that ratio.
const EXPANSION_FREE_BYTES: u64 = 32 << 20;

/// Returns `count` if a compressed file of `len_bytes` can hold that many Gaussians.
pub(super) fn plausible_count(
    path: &Path,
    place: impl Display,
    count: u64,
    degree: u8,
    len_bytes: u64,
) -> Result<usize, SplatError> {
    let bytes_each = Gaussians::decoded_bytes(1, degree) as u64;
    let most = len_bytes.saturating_mul(MAX_EXPANSION).saturating_add(EXPANSION_FREE_BYTES) / bytes_each;
    usize::try_from(count).ok().filter(|_| count <= most).ok_or_else(|| {
        let expected = format_args!("at most {most} Gaussians in {len_bytes} bytes");
        SplatError::malformed(path, place, expected, count)
    })
}

pub(super) fn columns(count: usize, degree: u8) -> Gaussians {
    Gaussians {
        means_in_world: Vec::with_capacity(count),
        rotations_wxyz: Vec::with_capacity(count),
        scales: Vec::with_capacity(count),
        opacities: Vec::with_capacity(count),
        sh_dc: Vec::with_capacity(count),
        sh_rest: Vec::with_capacity(count * 3 * Gaussians::sh_rest_per_channel(degree)),
        sh_degree: degree,
    }
}
