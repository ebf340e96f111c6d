//! Labelled segments of photos, and the masks that find them.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use slag_encoder::masks::{NO_REGION, RegionMap};

/// Smaller masks and segments do not count, as in `encode`.
pub(super) const MIN_PX: u32 = 200;

/// The best masks' intersections over union of labelled segments.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Ious {
    pub(super) n: usize,
    pub(super) sum: f64,
    pub(super) n_above_half: usize,
}

impl Ious {
    pub(super) fn mean(&self) -> Option<f64> {
        (self.n > 0).then(|| self.sum / self.n as f64)
    }

    /// Adds a photo: its masks, each pixel's id, and the ids of labelled things.
    pub(super) fn add(
        &mut self,
        regions: &RegionMap,
        masks_of_region: &[Vec<u32>],
        ids: &[u16],
        things: &BTreeSet<u16>,
    ) {
        let mut n_of_id: BTreeMap<u16, u64> = BTreeMap::new();
        let mut n_of_both: BTreeMap<(u16, u32), u64> = BTreeMap::new();
        for (id, region) in ids.iter().zip(&regions.region_of_pixel).filter(|(id, _)| things.contains(id)) {
            *n_of_id.entry(*id).or_default() += 1;
            *n_of_both.entry((*id, *region)).or_default() += 1;
        }
        let mut area_of_mask: BTreeMap<u32, u64> = BTreeMap::new();
        for region in regions.region_of_pixel.iter().filter(|region| **region != NO_REGION) {
            let masks = &masks_of_region[*region as usize];
            masks.iter().for_each(|mask| *area_of_mask.entry(*mask).or_default() += 1);
        }
        for (id, area) in n_of_id.into_iter().filter(|(_, area)| *area >= u64::from(MIN_PX)) {
            let of_id = || n_of_both.range((id, 0)..(id, NO_REGION));
            let mut n_of_mask: BTreeMap<u32, u64> = BTreeMap::new();
            for ((_, region), n) in of_id() {
                masks_of_region[*region as usize].iter().for_each(|m| *n_of_mask.entry(*m).or_default() += n);
            }
            let iou = |(mask, both): (&u32, &u64)| *both as f64 / (area + area_of_mask[mask] - both) as f64;
            let best = n_of_mask.iter().map(iou).fold(0.0, f64::max);
            self.n += 1;
            self.sum += best;
            self.n_above_half += usize::from(best >= 0.5);
        }
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
    /// of a mask with the background, 4; thing 5 has no mask.
    #[test]
    fn segments_have_a_best_mask() {
        let ids: Vec<u16> = (0..4000).map(|i| [1, 2, 3, 4, 5][i % 100 / 20]).collect();
        let masks = [
            rectangle(0, 0, 20, 40),
            rectangle(20, 0, 40, 18),
            rectangle(20, 18, 40, 36),
            rectangle(40, 0, 75, 40),
        ];
        let (regions, masks_of_region) = partition(&masks, 100, 40, 100, 40, None);
        let mut found = Ious::default();
        found.add(&regions, &masks_of_region, &ids, &BTreeSet::from([1, 2, 3, 5]));
        // Thing 3: 800 of 1400 pixels; thing 2: 360 of 800.
        let expected = 1.0 + 800.0 / 1400.0 + 360.0 / 800.0;
        assert!((found.sum - expected).abs() < 1e-12 && (found.n, found.n_above_half) == (4, 2), "{found:?}");
    }
}
