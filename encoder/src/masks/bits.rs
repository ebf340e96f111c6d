//! Yes or no for each of many pixels, a bit each.

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bits {
    words: Vec<u64>,
    len: usize,
}

impl Bits {
    pub fn of(value: bool, len: usize) -> Self {
        if value { (0..len).map(|_| true).collect() } else { Self { words: vec![0; len.div_ceil(64)], len } }
    }

    pub fn n_px(&self) -> usize {
        self.len
    }

    /// # Panics
    /// If `at` is not below the length.
    pub fn get(&self, at: usize) -> bool {
        assert!(at < self.len, "{at} of {} bits", self.len);
        self.words[at / 64] >> (at % 64) & 1 == 1
    }

    /// # Panics
    /// If `at` is not below the length.
    pub fn set(&mut self, at: usize, value: bool) {
        assert!(at < self.len, "{at} of {} bits", self.len);
        let bit = 1 << (at % 64);
        let word = &mut self.words[at / 64];
        *word = if value { *word | bit } else { *word & !bit };
    }

    pub fn iter(&self) -> impl Iterator<Item = bool> {
        (0..self.len).map(|at| self.get(at))
    }

    pub fn count(&self) -> usize {
        self.words.iter().map(|word| word.count_ones() as usize).sum()
    }
}

impl FromIterator<bool> for Bits {
    fn from_iter<I: IntoIterator<Item = bool>>(bits: I) -> Self {
        let mut made = Self::default();
        for bit in bits {
            if made.len.is_multiple_of(64) {
                made.words.push(0);
            }
            made.len += 1;
            if bit {
                made.set(made.len - 1, true);
            }
        }
        made.words.shrink_to_fit();
        made
    }
}

#[cfg(test)]
mod tests {
    use slag_math::random::Random;

    use super::*;

    /// Oracle: a byte each.
    #[test]
    fn bits_are_as_bytes() {
        let mut random = Random::new(5);
        for len in [0, 1, 63, 64, 65, 1000] {
            let mut bytes: Vec<bool> = (0..len).map(|_| random.unit() < 0.3).collect();
            let mut bits: Bits = bytes.iter().copied().collect();
            for at in (0..len).step_by(7) {
                bytes[at] ^= true;
                bits.set(at, bytes[at]);
            }
            assert!(bits.n_px() == len && bits.iter().eq(bytes.iter().copied()));
            assert_eq!(bits.count(), bytes.iter().filter(|byte| **byte).count());
            assert!((0..len).all(|at| bits.get(at) == bytes[at]) && bits.words.len() == len.div_ceil(64));
            assert_eq!(Bits::of(true, len).count(), len);
        }
    }
}
