//! Validation of region maps.

use slag_common::Intrinsics;

use super::error::RasterError;
use crate::masks::{NO_REGION, RegionMap};

/// Checks that a region map has the size of the view and no region number out of range.
pub(super) fn check_regions(regions: &RegionMap, intrinsics: &Intrinsics) -> Result<(), RasterError> {
    let expected_px = [intrinsics.width_px, intrinsics.height_px];
    let found_px = [regions.width_px, regions.height_px];
    let found_values = regions.region_of_pixel.len();
    if found_px != expected_px || found_values as u64 != u64::from(found_px[0]) * u64::from(found_px[1]) {
        return Err(RasterError::RegionMapSize { expected_px, found_px, found_values });
    }
    let n_regions = regions.n_regions;
    match regions.region_of_pixel.iter().position(|&r| r >= n_regions && r != NO_REGION) {
        Some(pixel) => Err(RasterError::Region { pixel, found: regions.region_of_pixel[pixel], n_regions }),
        None => Ok(()),
    }
}
