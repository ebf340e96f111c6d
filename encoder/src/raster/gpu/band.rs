//! Bands: the rows of tiles of a view that are processed together.

use slag_raster::constants::TILE_SIZE_PX;

use super::chunk::SceneChunk;
use super::device::Device;
use super::layout::ViewBlock;
use crate::raster::error::RasterError;

pub(crate) struct Band<'a> {
    pub device: &'a Device,
    pub chunks: &'a [SceneChunk],
    /// Uploads the Gaussians of a chunk that is not on the device.
    pub(crate) upload: &'a dyn Fn(usize) -> Result<wgpu::Buffer, RasterError>,
    /// The view and the rows of tiles of the band.
    pub view: &'a ViewBlock,
}

impl Band<'_> {
    /// Returns the number of columns and rows of tiles.
    pub fn tiles(&self) -> [u32; 2] {
        let [_, _, first_row, end_row, columns, ..] = self.view.words;
        [columns, end_row - first_row]
    }
}

pub(crate) fn band_size(width_px: u32, height_px: u32, tile_rows: [u32; 2]) -> (u32, u32) {
    let tile = TILE_SIZE_PX as u32;
    let rows_px = (tile_rows[1] * tile).min(height_px) - tile_rows[0] * tile;
    ((tile_rows[1] - tile_rows[0]) * width_px.div_ceil(tile), rows_px * width_px)
}
