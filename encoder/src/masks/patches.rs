//! The patches of an image model as masks: cells of a square grid that is stretched over the photo.

use std::collections::BTreeMap;

use super::mask::{BoxPx, Mask};
use super::patches;

/// Patches with pixels, with their numbers, row by row. Patch `k` of `per_side` covers the pixels whose centres lie in
/// `[k, k + 1) * width / per_side`, and the same down the photo.
pub(crate) fn patch_masks(per_side: u32, width_px: u32, height_px: u32) -> Vec<(usize, Mask)> {
    // First pixel with its centre at or after the patch's edge: ceil(k * edge / per_side - 1/2).
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

/// Share of a mask's pixels in each patch of [`patch_masks`] that has some, by number.
pub fn shares(mask: &Mask, per_side: u32, width_px: u32, height_px: u32) -> Vec<(usize, f32)> {
    // Patch of a pixel's centre: floor((x + 1/2) * per_side / edge).
    let patch = |x: u32, edge_px: u32| {
        ((2 * u64::from(x) + 1) * u64::from(per_side) / (2 * u64::from(edge_px.max(1)))) as usize
    };
    let BoxPx { x0, y0, x1, y1 } = mask.box_px;
    let columns: Vec<usize> = (x0..x1).map(|x| patch(x, width_px)).collect();
    let mut counts = BTreeMap::<usize, u32>::new();
    let mut inside = mask.inside.iter();
    for y in y0..y1 {
        let first = patch(y, height_px) * per_side as usize;
        for (column, _) in columns.iter().zip(inside.by_ref()).filter(|(_, inside)| *inside) {
            *counts.entry(first + column).or_default() += 1;
        }
    }
    let n: u32 = counts.values().sum();
    counts.into_iter().map(|(patch, count)| (patch, count as f32 / n as f32)).collect()
}

/// Windows over a photo: for each size `s`, `1/s` of its edges and half of that apart, so `(2 s - 1)^2`, row by row.
pub(crate) struct Windows {
    sizes: Vec<u32>,
    width_px: u32,
    height_px: u32,
}

impl Windows {
    /// Leaves out sizes that the photo is too small for.
    pub fn new(sizes: &[u8], width_px: u32, height_px: u32) -> Self {
        let fits = |size: &u32| *size > 0 && 2 * size <= width_px.min(height_px);
        Self { sizes: sizes.iter().map(|&size| u32::from(size)).filter(fits).collect(), width_px, height_px }
    }

    pub fn masks(&self) -> Vec<Mask> {
        let mut masks = Vec::new();
        for &size in &self.sizes {
            let edge =
                |k: u32, edge_px: u32| (u64::from(k) * u64::from(edge_px) / u64::from(2 * size)) as u32;
            let n = 2 * size - 1;
            for (row, column) in (0..n * n).map(|k| (k / n, k % n)) {
                let box_px = BoxPx {
                    x0: edge(column, self.width_px),
                    y0: edge(row, self.height_px),
                    x1: edge(column + 2, self.width_px),
                    y1: edge(row + 2, self.height_px),
                };
                masks.push(Mask::whole(box_px));
            }
        }
        masks
    }

    /// Share of a mask in each window that has some, by number: a pixel counts equally for all windows of a size that
    /// contain it, and equally for each size.
    pub fn shares(&self, mask: &Mask) -> Vec<(usize, f32)> {
        let mut shares = Vec::new();
        let mut first = 0;
        for &size in &self.sizes {
            let (n, per_side) = (2 * size as usize - 1, 2 * size as usize);
            let mut of_size = vec![0.0; n * n];
            for (cell, share) in patches::shares(mask, 2 * size, self.width_px, self.height_px) {
                // A cell is half a window wide, so it lies in the window that begins with it and the one before.
                let over = |k: usize| k.saturating_sub(1)..=k.min(n - 1);
                let (rows, columns) = (over(cell / per_side), over(cell % per_side));
                let each = share / (rows.clone().count() * columns.clone().count()) as f32;
                rows.flat_map(|row| columns.clone().map(move |column| row * n + column))
                    .for_each(|window| of_size[window] += each);
            }
            shares.extend((first..).zip(of_size).filter(|(_, share)| *share > 0.0));
            first += n * n;
        }
        shares
    }
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
                assert_eq!(mask.area_px as usize, mask.inside.n_px());
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
