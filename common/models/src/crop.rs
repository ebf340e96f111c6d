use std::sync::Arc;

use ::image::RgbImage;

/// A piece of a photograph and the mask of the object that it shows; clones share the pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Crop {
    image: Arc<RgbImage>,
    inside: Arc<[bool]>,
}

impl Crop {
    /// Returns a crop; `inside`: `[height][width]`, row-major. `None` if the sizes differ.
    pub fn new(image: RgbImage, inside: Vec<bool>) -> Option<Self> {
        let (width_px, height_px) = image.dimensions();
        (u64::from(width_px) * u64::from(height_px) == inside.len() as u64)
            .then(|| Self { image: image.into(), inside: inside.into() })
    }

    /// Returns a crop whose mask covers every pixel.
    pub fn whole(image: RgbImage) -> Self {
        let inside = vec![true; image.as_raw().len() / 3];
        Self { image: image.into(), inside: inside.into() }
    }

    /// Returns the pixels; the background may be filled.
    pub fn image(&self) -> &RgbImage {
        &self.image
    }

    /// Returns the mask, `[height][width]`, row-major.
    pub fn inside(&self) -> &[bool] {
        &self.inside
    }
}
