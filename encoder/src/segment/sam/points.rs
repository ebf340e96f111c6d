//! The prompts of automatic mask generation: grids of points, and crops of the image.

use crate::masks::BoxPx;

/// Centres of `n_per_side` x `n_per_side` cells of an image, pixels, row by row.
pub(super) fn grid(n_per_side: u32, width_px: u32, height_px: u32) -> Vec<[f64; 2]> {
    let at = |i: u32, edge_px: u32| (f64::from(i) + 0.5) / f64::from(n_per_side) * f64::from(edge_px);
    (0..n_per_side).flat_map(|y| (0..n_per_side).map(move |x| [at(x, width_px), at(y, height_px)])).collect()
}

/// Crops with their layers: the whole image as layer 0, and 2^i x 2^i crops for each further layer `i`. They overlap by
/// `overlap_ratio` of the shorter edge in layer 1, half of that in each further layer.
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
            // In tiny images, crops at the right and bottom may be empty.
            if x0 < crop.x1 && y0 < crop.y1 {
                crops.push((crop, layer));
            }
        }
    }
    crops
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grids_and_crops_are_those_of_the_reference() {
        let four = grid(2, 640, 480);
        assert_eq!(four, [[160.0, 120.0], [480.0, 120.0], [160.0, 360.0], [480.0, 360.0]]);
        assert_eq!(grid(32, 1000, 700).len(), 1024);
        // By hand: the overlap is int(512 / 1500 * 480 * 2 / 2) = 163 px, then 81 px; a crop is
        // ceil((163 + 640) / 2) = 402 px wide and ceil((163 + 480) / 2) = 322 px high, then 221 and 181 px.
        let crops = crops(640, 480, 2, 512.0 / 1500.0);
        assert_eq!(crops.len(), 1 + 4 + 16);
        let edges = |k: usize| (crops[k].1, crops[k].0.x0, crops[k].0.y0, crops[k].0.x1, crops[k].0.y1);
        assert_eq!(edges(0), (0, 0, 0, 640, 480));
        assert_eq!(
            [1, 2, 3, 4].map(edges),
            [(1, 0, 0, 402, 322), (1, 0, 159, 402, 480), (1, 239, 0, 640, 322), (1, 239, 159, 640, 480),]
        );
        assert_eq!(edges(5), (2, 0, 0, 221, 181));
        assert_eq!(edges(20), (2, 420, 300, 640, 480));
    }
}
