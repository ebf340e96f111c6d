//! Stage 2: a crop per mask, and a vector per crop.

use std::num::NonZeroUsize;

use image::{Rgb, RgbImage, imageops};
use slag_models::{
    Crop, EncodeError, ImageEncoder,
    preprocess::{Filter, Preprocess, Window, resample},
};

use crate::masks::{BoxPx, Mask};

/// Says why masks could not be embedded.
#[derive(Debug, thiserror::Error)]
pub enum EmbedError {
    /// A mask does not lie in the image, has a box of other size than its pixels, or no pixels.
    #[error(
        "mask {index}: box {box_px:?} with {n_inside} pixels inside does not fit an image of {width_px}x{height_px}; \
         segment this image again"
    )]
    Mask {
        /// Its index among the masks given.
        index: usize,
        /// Its box.
        box_px: BoxPx,
        /// Its pixels, counted.
        n_inside: usize,
        /// Width of the image.
        width_px: u32,
        /// Height of the image.
        height_px: u32,
    },
    /// The encoder failed on a batch.
    #[error("masks {first} to {last}: {cause}")]
    Encode {
        /// Index of the batch's first mask.
        first: usize,
        /// Index of the batch's last mask.
        last: usize,
        /// Why.
        cause: Box<EncodeError>,
    },
}

/// What a crop shows outside its mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
pub enum Background {
    /// White.
    White,
    /// The middle grey (128), which is 0 after most models' normalisation.
    Grey,
    /// The photograph, blurred: surroundings without detail.
    Blur,
    /// The photograph as it is.
    Keep,
}

/// Standard deviation of [`Background::Blur`] as a part of the box's longer edge: nothing beside the mask
/// can be recognised then, yet the colours around it stay.
const BLUR_OF_EDGE: f32 = 0.05;

/// Crops held at a time: large ones fill a batch before it has as many crops as the encoder prefers.
const MAX_BATCH_PIXELS: u64 = 1 << 24;

/// Returns the mask's tight box of the image; what lies outside the mask becomes `background`.
///
/// Returns `None` where the mask does not fit the image or has no pixels.
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

/// Returns `image` under a Gaussian of standard deviation `sigma_px`.
fn blurred(image: &RgbImage, sigma_px: f32) -> RgbImage {
    // A wide Gaussian leaves nothing that a smaller image does not show, and its time grows with its width.
    // Short edges keep 8 pixels, so that rounding them to pixels changes the proportions little.
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

/// Returns the crop of mask `index`, or says why there is none.
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

/// Returns each mask's crop as the square that the image encoder takes: small, whatever the photo's size.
/// # Errors
/// [`EmbedError::Mask`] where a mask does not fit the image.
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
