//! Stage 1: masks of an image, and the partition of the image that they make.

/// A box in pixels: `x0 <= x < x1`, `y0 <= y < y1`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BoxPx {
    /// Left, inclusive.
    pub x0: u32,
    /// Top, inclusive.
    pub y0: u32,
    /// Right, exclusive.
    pub x1: u32,
    /// Bottom, exclusive.
    pub y1: u32,
}

impl BoxPx {
    /// Returns the width in pixels.
    pub fn width_px(&self) -> u32 {
        self.x1 - self.x0
    }

    /// Returns the height in pixels.
    pub fn height_px(&self) -> u32 {
        self.y1 - self.y0
    }
}

/// One mask of an image: a set of pixels, which other masks may overlap.
#[derive(Clone, Debug, PartialEq)]
pub struct Mask {
    /// The tight box around its pixels.
    pub box_px: BoxPx,
    /// Membership, row-major within the box.
    pub inside: Vec<bool>,
    /// Number of pixels inside.
    pub area_px: u32,
    /// Coarseness, where the segmenter has several: 0 is the coarsest (whole objects).
    pub level: u8,
}

/// Marks a pixel that no mask covers in [`RegionMap::region_of_pixel`].
pub const NO_REGION: u32 = u32::MAX;

/// The partition of a view that its masks make: pixels with the same set of masks are a region.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionMap {
    /// Width, pixels.
    pub width_px: u32,
    /// Height, pixels.
    pub height_px: u32,
    /// Region of each pixel, row-major; [`NO_REGION`] where no mask lies.
    pub region_of_pixel: Vec<u32>,
    /// Number of regions; numbered in the order in which a row-major scan meets them.
    pub n_regions: u32,
}
