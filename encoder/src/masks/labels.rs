//! Masks from label images.

use super::mask::{BoxPx, Mask};
use super::regions::NO_REGION;

/// Converts a label image into one mask per label except [`NO_REGION`], in ascending order of the labels.
///
/// `labels`: row-major, `width_px` per row, each below `n_labels` or [`NO_REGION`]. Returns `None` if the boxes of
/// all masks together exceed `limit_bytes`.
pub fn masks_of_labels(
    labels: &[u32],
    width_px: u32,
    n_labels: usize,
    limit_bytes: u64,
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
    let box_bytes = |b: &BoxPx| u64::from(b.width_px()) * u64::from(b.height_px());
    let total_bytes: u64 = boxes.iter().filter(|(_, area)| *area > 0).map(|(b, _)| box_bytes(b)).sum();
    if total_bytes > limit_bytes {
        return None;
    }
    let mut slot_of_label = vec![usize::MAX; n_labels];
    let mut masks = Vec::new();
    for ((box_px, area_px), label) in boxes.into_iter().zip(0_u32..).filter(|((_, area), _)| *area > 0) {
        slot_of_label[label as usize] = masks.len();
        let inside = vec![false; box_bytes(&box_px) as usize];
        masks.push((label, Mask { box_px, inside, area_px, level: 0 }));
    }
    for (row, y) in rows() {
        for (label, x) in row.iter().zip(0_u32..).filter(|(label, _)| **label != NO_REGION) {
            let mask = &mut masks[slot_of_label[*label as usize]].1;
            let at = (y - mask.box_px.y0) as usize * mask.box_px.width_px() as usize
                + (x - mask.box_px.x0) as usize;
            mask.inside[at] = true;
        }
    }
    Some(masks)
}
