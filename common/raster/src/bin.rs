//! The Gaussians of each tile, near to far.

use rayon::prelude::*;
use slag_common::Intrinsics;

use crate::buckets::Buckets;
use crate::constants::TILE_SIZE_PX;
use crate::project::ScreenGaussian;

const TILE: u32 = TILE_SIZE_PX as u32;
/// Gaussians per task.
const CHUNK: usize = 4096;
/// Larger tiles are sorted by all threads together.
const MANY: usize = 1 << 16;

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tiles {
    /// Rows of tiles, top to bottom. Each has one bucket per tile, left to right: indices into the visible
    /// Gaussians, near to far.
    pub rows: Vec<Buckets<u32>>,
    pub width_px: u32,
    pub height_px: u32,
}

/// A key that sorts near to far, and the columns `first..=last` of tiles in a row.
type Candidate = (u64, (u32, u32));

/// Lists, for each tile, the Gaussians whose footprint may cover one of its pixel centres, sorted by camera z as `f32`,
/// then by index.
pub fn bin(visible: &[ScreenGaussian], camera: &Intrinsics) -> Tiles {
    let (width_px, height_px) = (camera.width_px, camera.height_px);
    let n_rows = height_px.div_ceil(TILE) as usize;
    // All reads of Gaussians happen here, where access is sequential.
    let chunks: Vec<Buckets<Candidate>> = visible
        .par_chunks(CHUNK)
        .enumerate()
        .map(|(chunk, part)| {
            let mut spanned = Vec::with_capacity(part.len());
            for (g, index) in part.iter().zip((chunk * CHUNK) as u64..) {
                let [low, high] = g.y_range_px();
                let Some((a, b)) = ScreenGaussian::pixels_within(low, high, height_px) else { continue };
                // Bits of positive floats sort like the floats. The index makes keys unique.
                let key = u64::from(g.depth.to_bits()) << 32 | index;
                let footprint = Footprint::new(g);
                for row in a / TILE..=b / TILE {
                    let columns = footprint.columns(row * TILE, camera);
                    spanned.extend(columns.map(|columns| ((key, columns), (row, row))));
                }
            }
            Buckets::new(n_rows, &spanned)
        })
        .collect();
    let rows = (0..n_rows)
        .into_par_iter()
        .map(|row| tile_row(chunks.iter().map(|chunk| chunk.of(row)), width_px))
        .collect();
    Tiles { rows, width_px, height_px }
}

fn tile_row<'a>(parts: impl Iterator<Item = &'a [Candidate]>, width_px: u32) -> Buckets<u32> {
    let candidates: Vec<Candidate> = parts.flatten().copied().collect();
    let mut tiles = Buckets::new(width_px.div_ceil(TILE) as usize, &candidates);
    for keys in tiles.iter_mut() {
        if keys.len() < MANY {
            keys.sort_unstable();
        } else {
            keys.par_sort_unstable();
        }
    }
    tiles.map(|key| key as u32)
}

struct Footprint<'a> {
    gaussian: &'a ScreenGaussian,
    reach2: f64,
    extent_y_px: f64,
    /// Distance in y from the centre to the rightmost point of the outline, pixels.
    y_of_rightmost: f64,
}

impl<'a> Footprint<'a> {
    fn new(gaussian: &'a ScreenGaussian) -> Self {
        let (reach2, extent_px) = (f64::from(gaussian.reach2), gaussian.extent_px());
        // At y = cov_xy / cov_xx * ex.
        let y_of_rightmost = gaussian.slope * gaussian.inv_height.powi(-2) * reach2 / extent_px.x;
        Self { gaussian, reach2, extent_y_px: extent_px.y, y_of_rightmost }
    }

    /// Returns the columns of tiles that the footprint touches in the row of tiles at `top_px`; exact to the
    /// pixel, apart from the margin of the reach.
    fn columns(&self, top_px: u32, camera: &Intrinsics) -> Option<(u32, u32)> {
        let g = self.gaussian;
        let bottom_px = (top_px + TILE).min(camera.height_px) - 1;
        let first = (f64::from(top_px) + 0.5 - g.mean_px.y).max(-self.extent_y_px);
        let last = (f64::from(bottom_px) + 0.5 - g.mean_px.y).min(self.extent_y_px);
        // Along y, the outline's x is concave on the right and convex on the left, so its extreme within the row
        // of tiles lies at the ellipse's extreme, clamped to the row.
        let y_right = self.y_of_rightmost.max(first).min(last);
        let y_left = (-self.y_of_rightmost).max(first).min(last);
        let half = |y: f64| (self.reach2 - (y * g.inv_height).powi(2)).max(0.0).sqrt() / g.inv_width;
        let low = g.mean_px.x + g.slope * y_left - half(y_left);
        let high = g.mean_px.x + g.slope * y_right + half(y_right);
        ScreenGaussian::pixels_within(low, high, camera.width_px).map(|(a, b)| (a / TILE, b / TILE))
    }
}
