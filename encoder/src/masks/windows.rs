//! Windows over a photo: what an image model that learnt from whole photos should see besides single things.

use super::mask::{BoxPx, Mask};
use super::patches;

/// Windows over a photo: for each size `s` those of `1/s` of its edges, half of one apart, so `(2 s - 1)^2`, row
/// by row.
pub(crate) struct Windows {
    sizes: Vec<u32>,
    width_px: u32,
    height_px: u32,
}

impl Windows {
    /// Windows of some sizes; those that a photo is too small for are left out.
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

    /// Returns the share of a mask in each window where it has some, by the window's number: a pixel counts for
    /// all windows of a size that it is in, alike, and for each size alike.
    pub fn shares(&self, mask: &Mask) -> Vec<(usize, f32)> {
        let mut shares = Vec::new();
        let mut first = 0;
        for &size in &self.sizes {
            let (n, per_side) = (2 * size as usize - 1, 2 * size as usize);
            let mut of_size = vec![0.0; n * n];
            for (cell, share) in patches::shares(mask, 2 * size, self.width_px, self.height_px) {
                // A cell is half a window wide: the window that begins with it, and the one before.
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
