//! Lists Gaussians per tile, near to far.

use rayon::prelude::*;
use slag_common::Intrinsics;

use super::buckets::Buckets;
use super::constants::TILE_SIZE_PX;
use super::project::ScreenGaussian;

/// Edge of a tile; a row of a 16k image has 1024.
const TILE: u32 = TILE_SIZE_PX as u32;
/// Gaussians a task that looks for rows.
const CHUNK: usize = 4096;
/// Gaussians of one tile from which on all threads sort it.
const MANY: usize = 1 << 16;

/// The Gaussians of every tile of an image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tiles {
    /// Rows of tiles, top to bottom; a bucket a tile, left to right, with indices into the visible
    /// Gaussians, near to far.
    pub rows: Vec<Buckets<u32>>,
    /// Image width, pixels.
    pub width_px: u32,
    /// Image height, pixels.
    pub height_px: u32,
}

/// A key that orders Gaussians near to far, and the columns of tiles `first..=last` in a row.
type Candidate = (u64, (u32, u32));

/// Lists the Gaussians whose footprint may hold a pixel centre of a tile, for every tile: by camera z
/// as `f32`, ties by index.
pub fn bin(visible: &[ScreenGaussian], camera: &Intrinsics) -> Tiles {
    let (width_px, height_px) = (camera.width_px, camera.height_px);
    let n_rows = height_px.div_ceil(TILE) as usize;
    // All that needs the Gaussian is done here, where they are read in their order.
    let chunks: Vec<Buckets<Candidate>> = visible
        .par_chunks(CHUNK)
        .enumerate()
        .map(|(chunk, part)| {
            let mut spanned = Vec::with_capacity(part.len());
            for (g, index) in part.iter().zip((chunk * CHUNK) as u64..) {
                let [low, high] = g.y_range_px();
                let Some((a, b)) = ScreenGaussian::pixels_within(low, high, height_px) else { continue };
                // Depths are positive, so their bits order as they do; the index makes every key unique.
                let key = u64::from(g.depth.to_bits()) << 32 | index;
                let outline = Footprint::new(g);
                for row in a / TILE..=b / TILE {
                    let columns = outline.columns(row * TILE, camera);
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

/// Lists the Gaussians of each tile of a row.
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

/// The edge of a footprint.
struct Footprint<'a> {
    gaussian: &'a ScreenGaussian,
    reach2: f64,
    extent_y_px: f64,
    /// Height over the centre at which the edge is furthest right, pixels.
    y_of_rightmost: f64,
}

impl<'a> Footprint<'a> {
    fn new(gaussian: &'a ScreenGaussian) -> Self {
        let (reach2, extent_px) = (f64::from(gaussian.reach2), gaussian.extent_px());
        // At y = cov_xy / cov_xx * ex.
        let y_of_rightmost = gaussian.slope * gaussian.inv_height.powi(-2) * reach2 / extent_px.x;
        Self { gaussian, reach2, extent_y_px: extent_px.y, y_of_rightmost }
    }

    /// Returns the columns of tiles that the footprint touches in the row of tiles at `top_px`; exact to
    /// the pixel, but for the margin of the reach.
    fn columns(&self, top_px: u32, camera: &Intrinsics) -> Option<(u32, u32)> {
        let g = self.gaussian;
        let bottom_px = (top_px + TILE).min(camera.height_px) - 1;
        let first = (f64::from(top_px) + 0.5 - g.mean_px.y).max(-self.extent_y_px);
        let last = (f64::from(bottom_px) + 0.5 - g.mean_px.y).min(self.extent_y_px);
        // x of the ellipse's edge is concave (right) or convex (left) in y: its extreme within the
        // band lies at the extreme of the whole ellipse, clamped.
        let y_right = self.y_of_rightmost.max(first).min(last);
        let y_left = (-self.y_of_rightmost).max(first).min(last);
        let half = |y: f64| (self.reach2 - (y * g.inv_height).powi(2)).max(0.0).sqrt() / g.inv_width;
        let low = g.mean_px.x + g.slope * y_left - half(y_left);
        let high = g.mean_px.x + g.slope * y_right + half(y_right);
        ScreenGaussian::pixels_within(low, high, camera.width_px).map(|(a, b)| (a / TILE, b / TILE))
    }
}
