//! One mask of an image.

use super::bits::Bits;

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
        let area_px = box_px.width_px() * box_px.height_px();
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
        (x0..x1).contains(&x)
            && (y0..y1).contains(&y)
            && self.inside.get((y - y0) as usize * self.box_px.width_px() as usize + (x - x0) as usize)
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
    let box_area_px = |b: &BoxPx| u64::from(b.width_px()) * u64::from(b.height_px());
    let total_px: u64 = boxes.iter().filter(|(_, area)| *area > 0).map(|(b, _)| box_area_px(b)).sum();
    if total_px > limit_px {
        return None;
    }
    let mut slot_of_label = vec![usize::MAX; n_labels];
    let mut masks = Vec::new();
    for ((box_px, area_px), label) in boxes.into_iter().zip(0_u32..).filter(|((_, area), _)| *area > 0) {
        slot_of_label[label as usize] = masks.len();
        let inside = Bits::of(false, box_area_px(&box_px) as usize);
        masks.push((label, Mask { box_px, inside, area_px, level: 0 }));
    }
    for (row, y) in rows() {
        for (label, x) in row.iter().zip(0_u32..).filter(|(label, _)| **label != NO_REGION) {
            let mask = &mut masks[slot_of_label[*label as usize]].1;
            let at = (y - mask.box_px.y0) as usize * mask.box_px.width_px() as usize
                + (x - mask.box_px.x0) as usize;
            mask.inside.set(at, true);
        }
    }
    Some(masks)
}
