//! The errors of the rasteriser.

use slag_raster::InputError;

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum RasterError {
    #[error(transparent)]
    Input(#[from] InputError),
    #[error(
        "the region map has {} x {} px ({found_values} values) but the view {} x {} px; \
         rasterise at the resolution of the masks",
        found_px[0], found_px[1], expected_px[0], expected_px[1]
    )]
    RegionMapSize { expected_px: [u32; 2], found_px: [u32; 2], found_values: usize },
    #[error("{adapter}: {what}; use --device cpu to work without it")]
    Device { adapter: String, what: String },
    #[error("{adapter}: {what}; rasterise at a smaller width or use --device cpu")]
    DeviceCapacity { adapter: String, what: String },
    #[error(
        "pixel {pixel} has region {found}, but the map has {n_regions} regions; create the region map again"
    )]
    Region { pixel: usize, found: u32, n_regions: u32 },
}
