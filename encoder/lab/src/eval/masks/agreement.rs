//! Agreement between views: a mask of one photo, drawn into the next by the splat's depth, should be a mask there.

use std::collections::BTreeMap;

use glam::DVec3;
use serde::Serialize;
use slag_encoder::masks::{NO_REGION, RegionMap};
use slag_encoder::raster::RasterView;

use super::segments::{Ious, MIN_PX, areas};

/// A point is hidden where its depth differs from the splat's by more than this, relatively.
const MAX_DEPTH_ERROR: f64 = 0.03;

pub(super) struct Seen {
    pub(super) view: RasterView,
    /// Camera z of each pixel; 0 where there is no splat.
    pub(super) depth: Vec<f32>,
    pub(super) regions: RegionMap,
    pub(super) masks_of_region: Vec<Vec<u32>>,
}

/// Best intersections over union of the first photos' masks with masks of the next, over the pixels that both
/// photos show.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Agreement {
    pub(super) ious: Ious,
}

impl Agreement {
    pub(super) fn add(&mut self, first: &Seen, second: &Seen) {
        let pixel_in_first = pixels_in(first, second);
        let is_shared = |pixel: usize| pixel_in_first[pixel].is_some();
        let of_second = areas(&second.regions, &second.masks_of_region, is_shared);
        let n_first = first.masks_of_region.iter().flatten().max().map_or(0, |most| *most as usize + 1);
        let mut of_first = vec![0u64; n_first];
        let mut n_of_regions: BTreeMap<(u32, u32), u64> = BTreeMap::new();
        for (pixel, region) in second.regions.region_of_pixel.iter().enumerate() {
            let Some(at) = pixel_in_first[pixel] else { continue };
            let region_in_first = first.regions.region_of_pixel[at as usize];
            if region_in_first != NO_REGION {
                *n_of_regions.entry((region_in_first, *region)).or_default() += 1;
            }
        }
        let mut n_of_both: BTreeMap<(u32, u32), u64> = BTreeMap::new();
        for ((a, b), n) in n_of_regions {
            for mask in &first.masks_of_region[a as usize] {
                of_first[*mask as usize] += n;
                let others = second.masks_of_region.get(b as usize).map_or(&[][..], Vec::as_slice);
                others.iter().for_each(|other| *n_of_both.entry((*mask, *other)).or_default() += n);
            }
        }
        for (mask, area) in (0u32..).zip(&of_first).filter(|(_, area)| **area >= u64::from(MIN_PX)) {
            let of_mask = n_of_both.range((mask, 0)..=(mask, u32::MAX));
            let iou = |((_, other), both): (&(u32, u32), &u64)| {
                *both as f64 / (area + of_second[*other as usize] - both) as f64
            };
            self.ious.add(of_mask.map(iou).fold(0.0, f64::max));
        }
    }
}

/// For each pixel of the second photo, finds the pixel of the first that shows the same point of the splat.
fn pixels_in(first: &Seen, second: &Seen) -> Vec<Option<u32>> {
    let first_from_second = first.view.camera_from_world * second.view.camera_from_world.inverse();
    let (k, to) = (second.view.intrinsics, first.view.intrinsics);
    let pixel = |(pixel, depth): (usize, &f32)| {
        let z = f64::from(*depth);
        if z <= 0.0 {
            return None;
        }
        let (x, y) = ((pixel as u32 % k.width_px) as f64 + 0.5, (pixel as u32 / k.width_px) as f64 + 0.5);
        let ray = DVec3::new((x - k.centre_x_px) / k.focal_x_px, (y - k.centre_y_px) / k.focal_y_px, 1.0);
        let point = first_from_second.transform_point3(ray * z);
        let u = to.focal_x_px * point.x / point.z + to.centre_x_px;
        let v = to.focal_y_px * point.y / point.z + to.centre_y_px;
        let is_inside = point.z > 0.0
            && (0.0..f64::from(to.width_px)).contains(&u)
            && (0.0..f64::from(to.height_px)).contains(&v);
        let at = is_inside.then(|| v as u32 * to.width_px + u as u32)?;
        let there = f64::from(first.depth[at as usize]);
        ((there - point.z).abs() <= MAX_DEPTH_ERROR * point.z).then_some(at)
    };
    second.depth.iter().enumerate().map(pixel).collect()
}

#[cfg(test)]
mod tests {
    use glam::DAffine3;
    use slag_encoder::masks::{BoxPx, Mask, regions::partition};

    use super::*;
    use crate::generate::compose::pinhole;

    /// A wall 2 m away, by a camera at `x`, with masks of these columns over its height of 60 pixels.
    fn seen(x: f64, columns: &[(u32, u32)]) -> Seen {
        let intrinsics = pinhole([80, 60], std::f64::consts::FRAC_PI_2);
        let mask = |(x0, x1): &(u32, u32)| Mask::whole(BoxPx { x0: *x0, y0: 0, x1: *x1, y1: 60 });
        let masks: Vec<Mask> = columns.iter().map(mask).collect();
        let (regions, masks_of_region) = partition(&masks, 80, 60, 80, 60, None);
        let camera_from_world = DAffine3::from_translation(DVec3::new(-x, 0.0, 0.0));
        let view = RasterView { camera_from_world, intrinsics };
        Seen { view, depth: vec![2.0; 80 * 60], regions, masks_of_region }
    }

    /// By hand: half a metre to the right the wall moves 10 of 80 pixels to the left, so columns 10 to 80 are
    /// shared.
    #[test]
    fn masks_agree_where_both_photos_show_them() {
        let of = |second: &[(u32, u32)]| {
            let mut agreement = Agreement::default();
            agreement.add(&seen(0.0, &[(20, 40)]), &seen(0.5, second));
            (agreement.ious.n, agreement.ious.sum)
        };
        assert_eq!(of(&[(10, 30)]), (1, 1.0));
        assert_eq!(of(&[(0, 5), (10, 20)]), (1, 0.5));
        // Beyond column 70 of the second photo the first shows nothing.
        assert_eq!(of(&[(10, 80)]), (1, 20.0 / 60.0));
        assert_eq!(of(&[]), (1, 0.0));
        // Behind something nearer, nothing is shared.
        let mut hidden = seen(0.5, &[(10, 30)]);
        hidden.depth.fill(1.0);
        let mut agreement = Agreement::default();
        agreement.add(&seen(0.0, &[(20, 40)]), &hidden);
        assert_eq!(agreement.ious.n, 0);
    }
}
