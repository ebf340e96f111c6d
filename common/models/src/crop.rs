use ::image::RgbImage;

/// A piece of a photograph and which of its pixels belong to the thing shown.
#[derive(Clone, Debug, PartialEq)]
pub struct Crop {
    image: RgbImage,
    inside: Vec<bool>,
}

impl Crop {
    /// Returns a crop; `inside`: `[height][width]`, row-major. `None` where the sizes differ.
    pub fn new(image: RgbImage, inside: Vec<bool>) -> Option<Self> {
        let (width_px, height_px) = image.dimensions();
        (u64::from(width_px) * u64::from(height_px) == inside.len() as u64).then_some(Self { image, inside })
    }

    /// Returns a crop of which every pixel belongs to the thing shown.
    pub fn whole(image: RgbImage) -> Self {
        let inside = vec![true; image.as_raw().len() / 3];
        Self { image, inside }
    }

    /// Returns the pixels, background filled.
    pub fn image(&self) -> &RgbImage {
        &self.image
    }

    /// Returns membership, `[height][width]`, row-major.
    pub fn inside(&self) -> &[bool] {
        &self.inside
    }
}
