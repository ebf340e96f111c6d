//! Where automatic masks are asked for: grids of points, and crops of the image.

use crate::masks::BoxPx;

/// Returns the points of a grid of `n_per_side` x `n_per_side` over an image of the given size, each in the
/// middle of its cell, row by row, pixels.
pub(super) fn grid(n_per_side: u32, width_px: u32, height_px: u32) -> Vec<[f64; 2]> {
    let at = |i: u32, edge_px: u32| (f64::from(i) + 0.5) / f64::from(n_per_side) * f64::from(edge_px);
    (0..n_per_side).flat_map(|y| (0..n_per_side).map(move |x| [at(x, width_px), at(y, height_px)])).collect()
}

/// Returns the whole image with layer 0 and, for each further layer `i`, 2^i x 2^i crops that overlap by
/// `overlap_ratio` of the shorter edge, halved from layer to layer.
pub(super) fn crops(width_px: u32, height_px: u32, n_layers: u32, overlap_ratio: f64) -> Vec<(BoxPx, u32)> {
    let mut crops = vec![(BoxPx { x0: 0, y0: 0, x1: width_px, y1: height_px }, 0)];
    for layer in 1..=n_layers {
        let n = 1_u32 << layer;
        let overlap_px = (overlap_ratio * f64::from(width_px.min(height_px)) * (2.0 / f64::from(n))) as u32;
        let len = |edge_px: u32| (overlap_px * (n - 1) + edge_px).div_ceil(n);
        let (width, height) = (len(width_px), len(height_px));
        for i in 0..n * n {
            let (x0, y0) = ((width - overlap_px) * (i / n), (height - overlap_px) * (i % n));
            let crop = BoxPx { x0, y0, x1: (x0 + width).min(width_px), y1: (y0 + height).min(height_px) };
            // Of tiny images nothing may be left at the right and below.
            if x0 < crop.x1 && y0 < crop.y1 {
                crops.push((crop, layer));
            }
        }
    }
    crops
}
