//! Indices of Gaussians in the input splat file, packed into as few bits as a cell's range of indices needs.
//!
//! Every profile may have the column. All indices have the same width, so any one can be read alone: `index[i] =
//! least + the width_bits bits from bit i * width_bits on`, bits counted from the lowest of each word.

use bytemuck::{Pod, Zeroable};

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct IndicesHeader {
    pub least: u32,
    /// Bits of an index, 0..=32.
    pub width_bits: u32,
}

#[derive(Clone, Copy, Debug)]
pub struct PackedIndices<'a> {
    pub header: IndicesHeader,
    /// `[ceil(N * width_bits / 32)]`.
    pub words: &'a [u32],
}

impl PackedIndices<'_> {
    pub fn get(&self, at: usize) -> u32 {
        self.header.least.wrapping_add(self.offset(at))
    }

    fn offset(&self, at: usize) -> u32 {
        let width = u64::from(self.header.width_bits);
        if width == 0 {
            return 0;
        }
        let bit = at as u64 * width;
        let (word, shift) = ((bit / 32) as usize, bit % 32);
        let high = self.words.get(word + 1).map_or(0, |high| u64::from(*high) << 32);
        ((u64::from(self.words[word]) | high) >> shift & ((1 << width) - 1)) as u32
    }

    /// Checks a column of `n` indices: width at most 32 bits, no index above the largest u32, zeros after the last.
    pub(super) fn check(&self, n: usize) -> Result<(), String> {
        let IndicesHeader { least, .. } = self.header;
        if let Some(at) = (0..n).find(|at| least.checked_add(self.offset(*at)).is_none()) {
            return Err(format!("input index of Gaussian {at} is above {}", u32::MAX));
        }
        let used = n as u64 * u64::from(self.header.width_bits) % 32;
        match self.words.last() {
            Some(last) if used > 0 && last >> used != 0 => {
                Err("bits after the last input index are not zero".into())
            }
            _ => Ok(()),
        }
    }
}

/// `None` for a width above 32 bits.
pub(super) fn n_words(n: usize, width_bits: u32) -> Option<usize> {
    (width_bits <= 32).then(|| (n as u64 * u64::from(width_bits)).div_ceil(32) as usize)
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct IndexColumn {
    header: IndicesHeader,
    words: Vec<u32>,
}

impl IndexColumn {
    pub fn pack(indices: &[u32]) -> Self {
        let least = indices.iter().copied().min().unwrap_or(0);
        let range = indices.iter().copied().max().unwrap_or(0) - least;
        let width_bits = u32::BITS - range.leading_zeros();
        let n_bits = indices.len() as u64 * u64::from(width_bits);
        let mut words = vec![0u32; n_bits.div_ceil(32) as usize];
        for (at, index) in indices.iter().enumerate().filter(|(_, index)| **index > least) {
            let bit = at as u64 * u64::from(width_bits);
            let (word, shift) = ((bit / 32) as usize, bit % 32);
            let bits = u64::from(index - least) << shift;
            words[word] |= bits as u32;
            if bits >> 32 != 0 {
                words[word + 1] |= (bits >> 32) as u32;
            }
        }
        Self { header: IndicesHeader { least, width_bits }, words }
    }

    pub fn view(&self) -> PackedIndices<'_> {
        PackedIndices { header: self.header, words: &self.words }
    }
}

#[cfg(test)]
mod tests;
