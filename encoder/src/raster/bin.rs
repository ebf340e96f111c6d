//! Lists Gaussians per tile, near to far.

use rayon::prelude::*;
use slag_common::Intrinsics;

use super::buckets::Buckets;
use super::constants::TILE_SIZE_PX;
use super::project::ScreenGaussian;

/// Edge of a tile; a row of a 16k image has 1024.
const TILE: u32 = TILE_SIZE_PX as u32;
/// Gaussians a task that looks for rows.
const CHUNK: usize = 8192;
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

/// Lists the Gaussians whose footprint may hold a pixel centre of a tile, for every tile: by camera z
/// as `f32`, ties by index.
pub fn bin(visible: &[ScreenGaussian], camera: &Intrinsics) -> Tiles {
    let (width_px, height_px) = (camera.width_px, camera.height_px);
    let n_rows = height_px.div_ceil(TILE) as usize;
    let chunks: Vec<Buckets<u32>> = visible
        .par_chunks(CHUNK)
        .enumerate()
        .map(|(chunk, part)| {
            let rows_of = |(g, index): (&ScreenGaussian, u32)| {
                let [low, high] = g.y_range_px();
                let (a, b) = ScreenGaussian::pixels_within(low, high, height_px)?;
                Some((index, (a / TILE, b / TILE)))
            };
            let spanned: Vec<_> = part.iter().zip((chunk * CHUNK) as u32..).filter_map(rows_of).collect();
            Buckets::new(n_rows, &spanned)
        })
        .collect();
    let rows = (0..n_rows)
        .into_par_iter()
        .map(|row| {
            let candidates = chunks.iter().flat_map(|chunk| chunk.of(row)).copied();
            tile_row(visible, candidates, row as u32 * TILE, camera)
        })
        .collect();
    Tiles { rows, width_px, height_px }
}

/// Lists the Gaussians of each tile of a row; exact to the pixel, but for the margin of the reach.
fn tile_row(
    visible: &[ScreenGaussian],
    candidates: impl Iterator<Item = u32>,
    top_px: u32,
    camera: &Intrinsics,
) -> Buckets<u32> {
    let bottom_px = (top_px + TILE).min(camera.height_px) - 1;
    let columns_of = |index: u32| {
        let g = &visible[index as usize];
        let (reach2, extent_px) = (f64::from(g.reach2), g.extent_px());
        let first = (f64::from(top_px) + 0.5 - g.mean_px.y).max(-extent_px.y);
        let last = (f64::from(bottom_px) + 0.5 - g.mean_px.y).min(extent_px.y);
        // x of the ellipse's edge is concave (right) or convex (left) in y: its extreme within the
        // band lies at the extreme of the whole ellipse, clamped. That is at y = cov_xy / cov_xx * ex.
        let y_of_rightmost = g.slope * g.inv_height.powi(-2) * reach2 / extent_px.x;
        let y_right = y_of_rightmost.max(first).min(last);
        let y_left = (-y_of_rightmost).max(first).min(last);
        let half = |y: f64| (reach2 - (y * g.inv_height).powi(2)).max(0.0).sqrt() / g.inv_width;
        let low = g.mean_px.x + g.slope * y_left - half(y_left);
        let high = g.mean_px.x + g.slope * y_right + half(y_right);
        let (a, b) = ScreenGaussian::pixels_within(low, high, camera.width_px)?;
        // Depths are positive, so their bits order as they do; the index makes every key unique.
        Some((u64::from(g.depth.to_bits()) << 32 | u64::from(index), (a / TILE, b / TILE)))
    };
    let spanned: Vec<_> = candidates.filter_map(columns_of).collect();
    let mut tiles = Buckets::new(camera.width_px.div_ceil(TILE) as usize, &spanned);
    for keys in tiles.iter_mut() {
        if keys.len() < MANY {
            keys.sort_unstable();
        } else {
            keys.par_sort_unstable();
        }
    }
    tiles.map(|key| key as u32)
}
