//! Placement of an image in the encoder's square.

/// Placement of an image in the encoder's square: the longer edge fills it and the rest is padding at the right or
/// the bottom (SAM), or the image is stretched over it (SAM 2).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Letterbox {
    /// Edge length of the square, in pixels.
    pub size_px: u32,
    /// Width and height of the image, in pixels.
    pub image_px: [u32; 2],
    /// Width and height of the resized image, in pixels.
    pub resized_px: [u32; 2],
    /// Whether the image is stretched over the square; masks then go to the image's size in one step.
    pub is_stretched: bool,
}

impl Letterbox {
    /// Returns the placement of an image of `image_px` (width, height; neither 0) in a square of `size_px` that
    /// keeps its proportions.
    pub fn new(size_px: u32, image_px: [u32; 2]) -> Self {
        let scale = f64::from(size_px) / f64::from(image_px[0].max(image_px[1]));
        let resized_px = image_px.map(|edge| ((f64::from(edge) * scale + 0.5) as u32).max(1));
        Self { size_px, image_px, resized_px, is_stretched: false }
    }

    /// Returns the placement of an image of `image_px` (width, height; neither 0) that is stretched over a square
    /// of `size_px`.
    pub fn stretched(size_px: u32, image_px: [u32; 2]) -> Self {
        Self { size_px, image_px, resized_px: [size_px; 2], is_stretched: true }
    }

    /// Converts a point from pixels of the image to pixels of the square.
    pub fn point(&self, point_px: [f64; 2]) -> [f32; 2] {
        std::array::from_fn(|axis| {
            (point_px[axis] * (f64::from(self.resized_px[axis]) / f64::from(self.image_px[axis]))) as f32
        })
    }
}
