//! One mask of an image.

/// Pixels outside all masks, in [`RegionMap::region_of_pixel`](super::RegionMap::region_of_pixel) and label images.
pub const NO_REGION: u32 = u32::MAX;

/// A box in pixels: `x0 <= x < x1`, `y0 <= y < y1`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BoxPx {
    pub x0: u32,
    pub y0: u32,
    pub x1: u32,
    pub y1: u32,
}

impl BoxPx {
    pub fn width_px(&self) -> u32 {
        self.x1 - self.x0
    }

    pub fn height_px(&self) -> u32 {
        self.y1 - self.y0
    }

    pub(crate) fn area_px(&self) -> u64 {
        u64::from(self.width_px()) * u64::from(self.height_px())
    }

    /// Place of a pixel in the box, row-major.
    pub(crate) fn place_of(&self, x: u32, y: u32) -> usize {
        (y - self.y0) as usize * self.width_px() as usize + (x - self.x0) as usize
    }

    /// The smallest box around both.
    pub(crate) fn join(self, other: Self) -> Self {
        Self {
            x0: self.x0.min(other.x0),
            y0: self.y0.min(other.y0),
            x1: self.x1.max(other.x1),
            y1: self.y1.max(other.y1),
        }
    }
}

/// A set of pixels of an image; masks may overlap.
#[derive(Clone, Debug, PartialEq)]
pub struct Mask {
    pub box_px: BoxPx,
    /// Row-major within the box.
    pub inside: Bits,
    pub area_px: u32,
    /// Coarseness, for segmenters with several levels: 0 is the coarsest (whole objects); or [`Mask::FILLER`].
    pub level: u8,
}

impl Mask {
    /// Level of a mask that only covers pixels without any other: its outline says nothing of things.
    pub(crate) const FILLER: u8 = u8::MAX;
    /// Level of a mask of a standing thing: from the splat's shape, not the photo.
    pub(crate) const STANDING: u8 = u8::MAX - 1;

    /// All pixels of a box, level 0.
    pub fn whole(box_px: BoxPx) -> Self {
        let area_px = box_px.area_px() as u32;
        Self { box_px, inside: Bits::of(true, area_px as usize), area_px, level: 0 }
    }

    /// The pixels of a box that are inside, level 0.
    #[cfg(test)]
    pub(crate) fn within(box_px: BoxPx, is_inside: impl Fn(u32, u32) -> bool) -> Self {
        let BoxPx { x0, y0, x1, y1 } = box_px;
        let pixels = (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y)));
        let inside: Bits = pixels.map(|(x, y)| is_inside(x, y)).collect();
        let area_px = inside.count() as u32;
        Self { box_px, inside, area_px, level: 0 }
    }

    pub fn contains(&self, x: u32, y: u32) -> bool {
        let BoxPx { x0, y0, x1, y1 } = self.box_px;
        (x0..x1).contains(&x) && (y0..y1).contains(&y) && self.inside.get(self.box_px.place_of(x, y))
    }
}

/// Makes one mask per label except [`NO_REGION`], ascending; `None` if the boxes of all masks together exceed
/// `limit_px`. `labels`: row-major, `width_px` per row, each below `n_labels` or [`NO_REGION`].
pub fn masks_of_labels(
    labels: &[u32],
    width_px: u32,
    n_labels: usize,
    limit_px: u64,
) -> Option<Vec<(u32, Mask)>> {
    let empty = BoxPx { x0: u32::MAX, y0: u32::MAX, x1: 0, y1: 0 };
    let mut boxes = vec![(empty, 0_u32); n_labels];
    let rows = || labels.chunks(width_px.max(1) as usize).zip(0_u32..);
    for (row, y) in rows() {
        for (label, x) in row.iter().zip(0_u32..).filter(|(label, _)| **label != NO_REGION) {
            let (box_px, area_px) = &mut boxes[*label as usize];
            box_px.x0 = box_px.x0.min(x);
            box_px.x1 = box_px.x1.max(x + 1);
            box_px.y0 = box_px.y0.min(y);
            box_px.y1 = y + 1;
            *area_px += 1;
        }
    }
    let total_px: u64 = boxes.iter().filter(|(_, area)| *area > 0).map(|(b, _)| b.area_px()).sum();
    if total_px > limit_px {
        return None;
    }
    let mut slot_of_label = vec![usize::MAX; n_labels];
    let mut masks = Vec::new();
    for ((box_px, area_px), label) in boxes.into_iter().zip(0_u32..).filter(|((_, area), _)| *area > 0) {
        slot_of_label[label as usize] = masks.len();
        let inside = Bits::of(false, box_px.area_px() as usize);
        masks.push((label, Mask { box_px, inside, area_px, level: 0 }));
    }
    for (row, y) in rows() {
        for (label, x) in row.iter().zip(0_u32..).filter(|(label, _)| **label != NO_REGION) {
            let mask = &mut masks[slot_of_label[*label as usize]].1;
            mask.inside.set(mask.box_px.place_of(x, y), true);
        }
    }
    Some(masks)
}

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
