//! Existing masks in the undistorted photo.

use crate::ingest::Undistorter;
use crate::masks::regions::partition;
use crate::masks::{BoxPx, Mask, NO_REGION};

/// Maps masks to the undistorted photo; masks outside it are dropped.
///
/// Each pixel looks up its source once for all masks: the partition of the masks is mapped as one label image, and
/// each mask is reassembled from its regions.
pub(super) fn undistorted(
    masks: &[Mask],
    undistorter: &Undistorter,
    width_px: u32,
    height_px: u32,
) -> Vec<Mask> {
    let (map, masks_of_region) = partition(masks, width_px, height_px, width_px, height_px, None);
    let labels = undistorter.labels(&map.region_of_pixel, NO_REGION);
    let covered = || {
        let with_position = labels.iter().zip(0_u32..).filter(|(region, _)| **region != NO_REGION);
        with_position.map(|(region, at)| (*region as usize, at % width_px, at / width_px))
    };

    let empty = BoxPx { x0: u32::MAX, y0: u32::MAX, x1: 0, y1: 0 };
    let join = |a: BoxPx, b: BoxPx| BoxPx {
        x0: a.x0.min(b.x0),
        y0: a.y0.min(b.y0),
        x1: a.x1.max(b.x1),
        y1: a.y1.max(b.y1),
    };
    let mut boxes = vec![(empty, 0); map.n_regions as usize];
    for (region, x, y) in covered() {
        let (box_px, area_px) = &mut boxes[region];
        *box_px = join(*box_px, BoxPx { x0: x, y0: y, x1: x + 1, y1: y + 1 });
        *area_px += 1;
    }
    let mut ideal: Vec<Mask> = masks
        .iter()
        .map(|mask| Mask { box_px: empty, inside: Vec::new(), area_px: 0, level: mask.level })
        .collect();
    for ((box_px, area_px), members) in boxes.iter().zip(&masks_of_region).filter(|((_, area), _)| *area > 0)
    {
        for member in members {
            let mask = &mut ideal[*member as usize];
            mask.box_px = join(mask.box_px, *box_px);
            mask.area_px += area_px;
        }
    }
    for mask in ideal.iter_mut().filter(|mask| mask.area_px > 0) {
        mask.inside = vec![false; mask.box_px.width_px() as usize * mask.box_px.height_px() as usize];
    }
    for (region, x, y) in covered() {
        for member in &masks_of_region[region] {
            let mask = &mut ideal[*member as usize];
            let row = (y - mask.box_px.y0) as usize * mask.box_px.width_px() as usize;
            mask.inside[row + (x - mask.box_px.x0) as usize] = true;
        }
    }
    ideal.retain(|mask| mask.area_px > 0);
    ideal
}
