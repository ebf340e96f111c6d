//! Embedding: a crop for each mask, and a vector for each crop.

mod patches;
mod shared;
mod surroundings;

use std::num::NonZeroUsize;

use image::{Rgb, RgbImage, imageops};
use slag_models::{
    Crop, ImageEncoder, InferenceError,
    preprocess::{Filter, Preprocess, Window, resample},
};

use crate::masks::{BoxPx, Mask};

pub use patches::{PatchUse, PhotoPatches};
pub use shared::{Failure, OpenEncoder, SharedEncoders};
pub use surroundings::Surroundings;

/// Reason why masks cannot be embedded.
#[derive(Debug, thiserror::Error)]
pub enum EmbedError {
    /// A mask is outside the image, is empty, or its box does not match its pixels.
    #[error(
        "mask {index}: box {box_px:?} with {n_inside} pixels inside does not fit an image of {width_px}x{height_px}; \
         segment this image again"
    )]
    Mask {
        /// Index of the mask.
        index: usize,
        /// Bounding box of the mask.
        box_px: BoxPx,
        /// Number of pixels in the mask.
        n_inside: usize,
        /// Width of the image.
        width_px: u32,
        /// Height of the image.
        height_px: u32,
    },
    /// The encoder failed on the patches of a photo, or has none.
    #[error("patches of the photo: {cause}")]
    Patches {
        /// The encoder's error.
        cause: Box<InferenceError>,
    },
    /// The encoder failed on a batch.
    #[error("masks {first} to {last}: {cause}")]
    Encode {
        /// Index of the first mask in the batch.
        first: usize,
        /// Index of the last mask in the batch.
        last: usize,
        /// The encoder's error.
        cause: Box<InferenceError>,
    },
}

/// Content of a crop outside its mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, serde::Serialize, serde::Deserialize)]
pub enum Background {
    /// White.
    White,
    /// Mid-grey (128), which is about 0 after the normalisation of most models.
    Grey,
    /// The blurred photo: surroundings without detail.
    Blur,
    /// The unchanged photo.
    Keep,
}

/// Standard deviation of [`Background::Blur`] relative to the longer edge of the box. It hides the surroundings of the
/// mask but keeps their colours.
const BLUR_OF_EDGE: f32 = 0.05;

/// Largest number of pixels in a batch of crops; large crops fill a batch before the encoder's preferred number.
const MAX_BATCH_PIXELS: u64 = 1 << 24;

/// Crops the image to the bounding box of a mask and replaces pixels outside the mask by the background.
///
/// Returns `None` if the mask does not fit the image or is empty.
pub fn crop(image: &RgbImage, mask: &Mask, background: Background) -> Option<Crop> {
    let BoxPx { x0, y0, x1, y1 } = mask.box_px;
    let fits = x0 < x1 && y0 < y1 && x1 <= image.width() && y1 <= image.height();
    if !fits || !mask.inside.contains(&true) {
        return None;
    }
    let mut pixels = imageops::crop_imm(image, x0, y0, x1 - x0, y1 - y0).to_image();
    if u64::from(x1 - x0) * u64::from(y1 - y0) != mask.inside.len() as u64 {
        return None;
    }
    let outside = pixels.pixels_mut().zip(&mask.inside).filter(|(_, inside)| !**inside);
    match background {
        Background::White => outside.for_each(|(pixel, _)| *pixel = Rgb([255; 3])),
        Background::Grey => outside.for_each(|(pixel, _)| *pixel = Rgb([128; 3])),
        Background::Keep => {}
        Background::Blur => {
            let blurred = blurred(&pixels, BLUR_OF_EDGE * (x1 - x0).max(y1 - y0) as f32);
            let outside =
                pixels.pixels_mut().zip(blurred.pixels()).zip(&mask.inside).filter(|(_, inside)| !**inside);
            outside.for_each(|((pixel, blurred), _)| *pixel = *blurred);
        }
    }
    Crop::new(pixels, mask.inside.clone())
}

/// Blurs an image with a Gaussian of standard deviation `sigma_px`.
fn blurred(image: &RgbImage, sigma_px: f32) -> RgbImage {
    // A wide Gaussian removes all detail beyond that of a smaller image, and its cost grows with its width. Short
    // edges keep at least 8 pixels, so that rounding changes the proportions little.
    let short_px = image.width().min(image.height()) as f32;
    let shrink = (sigma_px / 4.0).min(short_px / 8.0).max(1.0);
    let [width, height] =
        [image.width(), image.height()].map(|edge| ((edge as f32 / shrink).round() as u32).max(1));
    let small = imageops::blur(&resized(image, width, height), sigma_px / shrink);
    resized(&small, image.width(), image.height())
}

fn resized(image: &RgbImage, width_px: u32, height_px: u32) -> RgbImage {
    let whole = Window { left_px: 0, top_px: 0, width_px, height_px };
    resample(image, Filter::Bicubic, [width_px, height_px].map(u64::from), whole)
}

/// Returns the crop of mask `index`, or the error.
fn crop_of(
    image: &RgbImage,
    (index, mask): (usize, &Mask),
    background: Background,
) -> Result<Crop, EmbedError> {
    crop(image, mask, background).ok_or_else(|| EmbedError::Mask {
        index,
        box_px: mask.box_px,
        n_inside: mask.inside.iter().filter(|&&inside| inside).count(),
        width_px: image.width(),
        height_px: image.height(),
    })
}

/// Returns the crop of each mask as the small square that the image encoder takes.
/// # Errors
/// [`EmbedError::Mask`] if a mask does not fit the image.
pub fn squares(
    image: &RgbImage,
    masks: &[Mask],
    background: Background,
    preprocess: &Preprocess,
) -> Result<Vec<Crop>, EmbedError> {
    let square = |mask| Ok(Crop::whole(preprocess.square(crop_of(image, mask, background)?.image())));
    masks.iter().enumerate().map(square).collect()
}

/// Returns a unit vector per crop, `[crops][dim]`; the first crop is that of mask `first`.
/// # Errors
/// [`EmbedError::Encode`] where the encoder fails.
pub fn embed_crops(
    crops: &[Crop],
    first: usize,
    encoder: &mut dyn ImageEncoder,
) -> Result<Vec<f32>, EmbedError> {
    encoder.encode(crops).map_err(|cause| EmbedError::Encode {
        first,
        last: (first + crops.len()).saturating_sub(1),
        cause: Box::new(cause),
    })
}

/// Returns a unit vector per mask, `[masks][dim]`.
///
/// `batch`: crops given to the encoder at once, its own preference if `None`. Batches depend on the masks
/// alone, so that models whose vectors vary with the batch (8-bit ones with scales found at run time)
/// give the same ones on every machine. Memory: one batch of crops, 48 MiB of pixels or one crop.
/// # Errors
/// [`EmbedError`] where a mask does not fit the image, or the encoder fails.
pub fn embed_masks(
    image: &RgbImage,
    masks: &[Mask],
    encoder: &mut dyn ImageEncoder,
    background: Background,
    batch: Option<NonZeroUsize>,
) -> Result<Vec<f32>, EmbedError> {
    let batch = batch.map_or(encoder.preferred_batch(), NonZeroUsize::get);
    let mut vectors = Vec::with_capacity(masks.len() * encoder.dim());
    let mut crops = Vec::new();
    let mut n_pixels = 0;
    for (index, mask) in masks.iter().enumerate() {
        let crop = crop_of(image, (index, mask), background)?;
        n_pixels += mask.inside.len() as u64;
        crops.push(crop);
        if crops.len() >= batch || n_pixels >= MAX_BATCH_PIXELS || index + 1 == masks.len() {
            vectors.extend(embed_crops(&crops, index + 1 - crops.len(), encoder)?);
            crops.clear();
            n_pixels = 0;
        }
    }
    Ok(vectors)
}
