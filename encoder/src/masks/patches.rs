//! The patches of an image model as masks: cells of a square grid that is stretched over the photo.

use std::collections::BTreeMap;

use super::mask::{BoxPx, Mask};

/// Returns the patches of a photo that have pixels, with their numbers, row by row. Patch `k` of `per_side` covers
/// the pixels whose centres lie in `[k, k + 1) * width / per_side`, and the same down the photo.
pub(crate) fn patch_masks(per_side: u32, width_px: u32, height_px: u32) -> Vec<(usize, Mask)> {
    // The first pixel whose centre is at or after the patch's edge: ceil(k * edge / per_side - 1/2).
    let first = |k: u32, edge_px: u32| {
        let (k, edge, n) = (u64::from(k), u64::from(edge_px), u64::from(per_side.max(1)));
        (2 * k * edge).saturating_sub(n).div_ceil(2 * n) as u32
    };
    let mut patches = Vec::new();
    for row in 0..per_side {
        let (y0, y1) = (first(row, height_px), first(row + 1, height_px));
        for column in 0..per_side {
            let (x0, x1) = (first(column, width_px), first(column + 1, width_px));
            if x0 < x1 && y0 < y1 {
                let mask = Mask::whole(BoxPx { x0, y0, x1, y1 });
                patches.push(((row * per_side + column) as usize, mask));
            }
        }
    }
    patches
}

/// Returns the share of a mask's pixels in each patch where it has some, by number of the patch. Patches are those
/// of [`patch_masks`].
pub fn shares(mask: &Mask, per_side: u32, width_px: u32, height_px: u32) -> Vec<(usize, f32)> {
    // The patch of a pixel's centre: floor((x + 1/2) * per_side / edge).
    let patch = |x: u32, edge_px: u32| {
        ((2 * u64::from(x) + 1) * u64::from(per_side) / (2 * u64::from(edge_px.max(1)))) as usize
    };
    let BoxPx { x0, y0, x1, y1 } = mask.box_px;
    let columns: Vec<usize> = (x0..x1).map(|x| patch(x, width_px)).collect();
    let mut counts = BTreeMap::<usize, u32>::new();
    for (y, row) in (y0..y1).zip(mask.inside.chunks_exact(columns.len().max(1))) {
        let first = patch(y, height_px) * per_side as usize;
        for (column, _) in columns.iter().zip(row).filter(|(_, inside)| **inside) {
            *counts.entry(first + column).or_default() += 1;
        }
    }
    let n: u32 = counts.values().sum();
    counts.into_iter().map(|(patch, count)| (patch, count as f32 / n as f32)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the patch of each pixel's centre, by the definition in floating point.
    #[test]
    fn every_pixel_is_in_the_patch_of_its_centre() {
        for (per_side, width, height) in [(4, 40, 20), (4, 37, 23), (32, 640, 480), (8, 5, 300), (3, 1, 1)] {
            let patches = patch_masks(per_side, width, height);
            let mut seen = vec![0; (width * height) as usize];
            for (index, mask) in &patches {
                assert_eq!(mask.area_px as usize, mask.inside.len());
                for y in mask.box_px.y0..mask.box_px.y1 {
                    for x in mask.box_px.x0..mask.box_px.x1 {
                        let of = |at: u32, edge: u32| {
                            ((f64::from(at) + 0.5) * f64::from(per_side) / f64::from(edge)).floor() as usize
                        };
                        assert_eq!(
                            *index,
                            of(y, height) * per_side as usize + of(x, width),
                            "{per_side} {width}x{height} at {x},{y}"
                        );
                        seen[(y * width + x) as usize] += 1;
                    }
                }
            }
            assert!(seen.iter().all(|&n| n == 1), "{per_side} {width}x{height}");
            assert!(patches.windows(2).all(|pair| pair[0].0 < pair[1].0));
        }
    }
}
