//! Orders Gaussians by depth and lists them per tile.

use rayon::prelude::*;
use slag_common::Intrinsics;

use super::constants::TILE_SIZE_PX;
use super::project::ScreenGaussian;

/// Tiles a task looks at; a row of a 16k image has 1024.
const TILE: u32 = TILE_SIZE_PX as u32;

/// The Gaussians of a row of tiles.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TileRow {
    /// Tile `t` of the row holds `members[starts[t]..starts[t + 1]]`; one more than tiles.
    pub starts: Vec<usize>,
    /// Indices into the visible Gaussians, near to far within a tile.
    pub members: Vec<u32>,
}

impl TileRow {
    /// Returns the members of each tile, left to right.
    pub fn tiles(&self) -> impl Iterator<Item = &[u32]> {
        self.starts.windows(2).map(|ends| &self.members[ends[0]..ends[1]])
    }
}

/// The Gaussians of every tile of an image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tiles {
    /// Rows of tiles, top to bottom.
    pub rows: Vec<TileRow>,
    /// Image width, pixels.
    pub width_px: u32,
    /// Image height, pixels.
    pub height_px: u32,
}

/// Lists the Gaussians whose footprint may hold a pixel centre of a tile, for every tile.
pub fn bin(visible: &[ScreenGaussian], camera: &Intrinsics) -> Tiles {
    let (width_px, height_px) = (camera.width_px, camera.height_px);
    let by_row = by_tile_row(visible, height_px);
    let rows = (0..by_row.starts.len() - 1)
        .into_par_iter()
        .map(|row| {
            let candidates = &by_row.members[by_row.starts[row]..by_row.starts[row + 1]];
            tile_row(visible, candidates, row as u32 * TILE, camera)
        })
        .collect();
    Tiles { rows, width_px, height_px }
}

/// Lists the Gaussians of each row of tiles, near to far: camera z as `f32`, ties by index.
fn by_tile_row(visible: &[ScreenGaussian], height_px: u32) -> TileRow {
    // Depths are positive, so their bits order as they do; the index makes every key unique.
    let mut order: Vec<u64> = visible
        .iter()
        .enumerate()
        .map(|(index, g)| u64::from(g.depth.to_bits()) << 32 | index as u64)
        .collect();
    order.par_sort_unstable();
    let order: Vec<u32> = order.into_iter().map(|key| key as u32).collect();
    let rows_of = |index: u32| {
        let g = &visible[index as usize];
        let [low, high] = g.y_range_px();
        ScreenGaussian::pixels_within(low, high, height_px).map(|(a, b)| (a / TILE, b / TILE))
    };
    group(&order, height_px.div_ceil(TILE) as usize, rows_of)
}

/// Lists the Gaussians of each tile of a row; exact to the pixel, but for the margin of the reach.
fn tile_row(visible: &[ScreenGaussian], candidates: &[u32], top_px: u32, camera: &Intrinsics) -> TileRow {
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
        ScreenGaussian::pixels_within(low, high, camera.width_px).map(|(a, b)| (a / TILE, b / TILE))
    };
    group(candidates, camera.width_px.div_ceil(TILE) as usize, columns_of)
}

/// Distributes items over the buckets `first..=last` that each belongs to, keeping their order.
fn group(items: &[u32], n_buckets: usize, span_of: impl Fn(u32) -> Option<(u32, u32)>) -> TileRow {
    let spans: Vec<Option<(u32, u32)>> = items.iter().map(|&item| span_of(item)).collect();
    let mut starts = vec![0_usize; n_buckets + 1];
    for &(first, last) in spans.iter().flatten() {
        for bucket in first..=last {
            starts[bucket as usize + 1] += 1;
        }
    }
    for bucket in 0..n_buckets {
        starts[bucket + 1] += starts[bucket];
    }
    let mut members = vec![0; starts[n_buckets]];
    let mut next = starts.clone();
    for (&item, span) in items.iter().zip(&spans) {
        let Some((first, last)) = *span else { continue };
        for bucket in first..=last {
            members[next[bucket as usize]] = item;
            next[bucket as usize] += 1;
        }
    }
    TileRow { starts, members }
}
