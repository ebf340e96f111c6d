//! Labelled segments of photos, and the masks that find them.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use slag_encoder::masks::{NO_REGION, RegionMap};

use crate::table::percent;

/// Areas below which a segment is small, and from which it is large (COCO).
const SMALL_PX: u64 = 32 * 32;
const LARGE_PX: u64 = 96 * 96;
/// Share of a mask within a segment, or of a segment within a mask, that makes it a part.
const INSIDE: f64 = 0.75;

/// How well masks find labelled segments.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Segments {
    /// Things: small, medium, large ones.
    pub(super) by_size: [Ious; 3],
    pub(super) background: Ious,
    /// Things that no mask finds at IoU 0.5: most of their pixels lie in masks inside them.
    pub(super) n_split: usize,
    /// A mask holds them and more.
    pub(super) n_merged: usize,
    /// Neither.
    pub(super) n_lost: usize,
}

impl Segments {
    pub(super) fn things(&self) -> Ious {
        let mut all = Ious::default();
        for of_size in &self.by_size {
            all.n += of_size.n;
            all.sum += of_size.sum;
            all.n_above_half += of_size.n_above_half;
        }
        all
    }

    /// Adds a photo: its masks, each pixel's id, the labelled ids, and those of them that are things.
    pub(super) fn add(
        &mut self,
        regions: &RegionMap,
        masks_of_region: &[Vec<u32>],
        ids: &[u16],
        known: &BTreeSet<u16>,
        things: &BTreeSet<u16>,
    ) {
        let mut n_of_id: BTreeMap<u16, u64> = BTreeMap::new();
        let mut n_of_both: BTreeMap<(u16, u32), u64> = BTreeMap::new();
        for (id, region) in ids.iter().zip(&regions.region_of_pixel).filter(|(id, _)| known.contains(id)) {
            *n_of_id.entry(*id).or_default() += 1;
            *n_of_both.entry((*id, *region)).or_default() += 1;
        }
        let area_of_mask = areas(regions, masks_of_region, |_| true);
        for (id, area) in n_of_id.into_iter().filter(|(_, area)| *area >= u64::from(MIN_PX)) {
            let of_id = || n_of_both.range((id, 0)..(id, NO_REGION));
            let mut n_of_mask: BTreeMap<u32, u64> = BTreeMap::new();
            for ((_, region), n) in of_id() {
                masks_of_region[*region as usize].iter().for_each(|m| *n_of_mask.entry(*m).or_default() += n);
            }
            let iou = |(mask, both): (&u32, &u64)| {
                *both as f64 / (area + area_of_mask[*mask as usize] - both) as f64
            };
            let best = n_of_mask.iter().map(iou).fold(0.0, f64::max);
            if !things.contains(&id) {
                self.background.add(best);
                continue;
            }
            let size = usize::from(area >= SMALL_PX) + usize::from(area >= LARGE_PX);
            self.by_size[size].add(best);
            if best >= 0.5 {
                continue;
            }
            let is_inside =
                |mask: &u32| n_of_mask[mask] as f64 >= INSIDE * area_of_mask[*mask as usize] as f64;
            let in_parts =
                of_id().filter(|((_, region), _)| masks_of_region[*region as usize].iter().any(is_inside));
            let n_in_parts: u64 = in_parts.map(|(_, n)| n).sum();
            let is_held = n_of_mask.values().any(|both| *both as f64 >= INSIDE * area as f64);
            match (2 * n_in_parts >= area, is_held) {
                (true, _) => self.n_split += 1,
                (false, true) => self.n_merged += 1,
                (false, false) => self.n_lost += 1,
            }
        }
    }
}

/// Smaller masks and segments do not count, as in `encode`.
pub(super) const MIN_PX: u32 = 200;

pub(super) fn areas(
    regions: &RegionMap,
    masks_of_region: &[Vec<u32>],
    counts: impl Fn(usize) -> bool,
) -> Vec<u64> {
    let n = masks_of_region.iter().flatten().max().map_or(0, |most| *most as usize + 1);
    let mut areas = vec![0; n];
    let pixels = regions.region_of_pixel.iter().enumerate();
    for (_, region) in pixels.filter(|(pixel, region)| **region != NO_REGION && counts(*pixel)) {
        masks_of_region[*region as usize].iter().for_each(|mask| areas[*mask as usize] += 1);
    }
    areas
}

/// The best masks' intersections over union of some segments.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Ious {
    pub(super) n: usize,
    pub(super) sum: f64,
    pub(super) n_above_half: usize,
}

impl Ious {
    pub(super) fn add(&mut self, iou: f64) {
        self.n += 1;
        self.sum += iou;
        self.n_above_half += usize::from(iou >= 0.5);
    }

    pub(super) fn mean(&self) -> Option<f64> {
        (self.n > 0).then(|| self.sum / self.n as f64)
    }

    pub(super) fn found(&self) -> String {
        percent(self.n_above_half as u64, self.n as u64)
    }
}

#[cfg(test)]
mod tests {
    use slag_encoder::masks::regions::partition;
    use slag_encoder::masks::{BoxPx, Mask};

    use super::*;

    fn rectangle(x0: u32, y0: u32, x1: u32, y1: u32) -> Mask {
        Mask::whole(BoxPx { x0, y0, x1, y1 })
    }

    /// By hand, on 100 x 40 pixels in columns of 20: thing 1 is a mask's; thing 2 is two masks'; thing 3 is half
    /// of a mask with background 4; thing 5 has no mask; 255 is unlabelled.
    #[test]
    fn segments_are_found_split_merged_or_lost() {
        let ids: Vec<u16> = (0..4000).map(|i| [1, 2, 3, 4, 5][i % 100 / 20]).collect();
        let masks = [
            rectangle(0, 0, 20, 40),
            rectangle(20, 0, 40, 18),
            rectangle(20, 18, 40, 36),
            rectangle(40, 0, 75, 40),
        ];
        let (regions, masks_of_region) = partition(&masks, 100, 40, 100, 40, None);
        let mut segments = Segments::default();
        let (known, things) = (BTreeSet::from([1, 2, 3, 4, 5]), BTreeSet::from([1, 2, 3, 5]));
        segments.add(&regions, &masks_of_region, &ids, &known, &things);
        let all = segments.things();
        assert_eq!((all.n, segments.by_size[0].n, segments.background.n), (4, 4, 1));
        // Thing 3: 800 of 1400 pixels; thing 2: 360 of 800; background: 600 of 1400 + 200.
        let expected = 1.0 + 800.0 / 1400.0 + 360.0 / 800.0;
        assert!((all.sum - expected).abs() < 1e-12 && all.n_above_half == 2, "{all:?}");
        assert!((segments.background.sum - 600.0 / 1600.0).abs() < 1e-12);
        assert_eq!((segments.n_split, segments.n_merged, segments.n_lost), (1, 0, 1));
        // A mask around all of things 3 and 4 and more holds thing 3, which is no half of it.
        let (regions, masks_of_region) = partition(&[rectangle(38, 0, 100, 40)], 100, 40, 100, 40, None);
        let mut segments = Segments::default();
        segments.add(&regions, &masks_of_region, &ids, &known, &BTreeSet::from([3]));
        assert_eq!((segments.n_split, segments.n_merged, segments.n_lost), (0, 1, 0));
    }
}
