//! Embedding: a crop for each mask, and a vector for each crop.

mod shared;
mod surroundings;

use std::num::NonZeroUsize;

use image::{Rgb, RgbImage, imageops};
use slag_models::{Crop, ImageEncoder, InferenceError, preprocess::Preprocess};

use crate::masks::{BoxPx, Mask};

pub(crate) use shared::{Failure, SharedEncoders};
pub(crate) use surroundings::Surroundings;

#[derive(Debug, thiserror::Error)]
pub enum EmbedError {
    #[error(
        "mask {index}: box {box_px:?} with {n_inside} pixels inside does not fit an image of {width_px}x{height_px}; \
         segment this image again"
    )]
    Mask { index: usize, box_px: BoxPx, n_inside: usize, width_px: u32, height_px: u32 },
    #[error("patches of the photo: {cause}")]
    Patches { cause: Box<InferenceError> },
    #[error("masks {first} to {last}: {cause}")]
    Encode { first: usize, last: usize, cause: Box<InferenceError> },
}

impl EmbedError {
    /// Whether crops or photo are at fault; a model that cannot run fails on other views, too.
    pub(crate) fn is_of_crops(&self) -> bool {
        match self {
            Self::Mask { .. } => true,
            Self::Patches { cause } | Self::Encode { cause, .. } => {
                !matches!(**cause, InferenceError::Session(_))
            }
        }
    }
}

pub(crate) enum PatchUse {
    /// Each of these patches is a region with a vector of its own; row by row.
    Regions(Vec<usize>),
    Masks(Surroundings),
}

impl PatchUse {
    /// Appends the regions' vectors to those of the crops, `[masks][dim]`, or mixes the patches in; all are unit
    /// vectors.
    pub(crate) fn add_to(
        &self,
        photo: &RgbImage,
        vectors: &mut Vec<f32>,
        encoder: &mut dyn ImageEncoder,
    ) -> Result<(), EmbedError> {
        let of_patches = encoder
            .encode_patches(photo)
            .map_err(|cause| EmbedError::Patches { cause: Box::new(cause) })?
            .unwrap_or_default();
        let dim = encoder.dim();
        match self {
            Self::Regions(numbers) => {
                let chosen = numbers.iter().filter_map(|&k| of_patches.get(k * dim..(k + 1) * dim));
                vectors.extend(chosen.flatten());
            }
            Self::Masks(surroundings) => surroundings.mix(vectors, &of_patches, dim),
        }
        Ok(())
    }
}

/// Largest number of pixels in a batch of crops; large crops fill a batch before the encoder's preferred number.
const MAX_BATCH_PIXELS: u64 = 1 << 21;

/// Most crops in a batch on the processor, unless model.toml says otherwise.
const BATCH: u64 = 32;

/// Bytes of the crops that [`embed_masks`] holds of a photo of this size: a batch, and one that is being cut.
pub(crate) fn batch_bytes(squares: Option<&Preprocess>, photo_px: u64) -> u64 {
    let batch_px = match squares {
        Some(preprocess) => BATCH * u64::from(preprocess.size_px()).pow(2),
        None => MAX_BATCH_PIXELS.min(BATCH * photo_px),
    };
    // Three colours, and whether the pixel is inside the mask.
    4 * (batch_px + photo_px)
}

/// Crops the image to a mask's bounding box, white outside the mask; `None` if the mask is empty or does not fit.
pub fn crop(image: &RgbImage, mask: &Mask) -> Option<Crop> {
    let BoxPx { x0, y0, x1, y1 } = mask.box_px;
    let fits = x0 < x1 && y0 < y1 && x1 <= image.width() && y1 <= image.height();
    if !fits || mask.inside.count() == 0 {
        return None;
    }
    let mut pixels = imageops::crop_imm(image, x0, y0, x1 - x0, y1 - y0).to_image();
    if u64::from(x1 - x0) * u64::from(y1 - y0) != mask.inside.n_px() as u64 {
        return None;
    }
    let outside = pixels.pixels_mut().zip(mask.inside.iter()).filter(|(_, inside)| !*inside);
    outside.for_each(|(pixel, _)| *pixel = Rgb([255; 3]));
    Crop::new(pixels, mask.inside.iter().collect())
}

fn crop_of(image: &RgbImage, (index, mask): (usize, &Mask)) -> Result<Crop, EmbedError> {
    crop(image, mask).ok_or_else(|| EmbedError::Mask {
        index,
        box_px: mask.box_px,
        n_inside: mask.inside.count(),
        width_px: image.width(),
        height_px: image.height(),
    })
}

/// Crops each mask to the small square that the image encoder takes.
pub fn squares(image: &RgbImage, masks: &[Mask], preprocess: &Preprocess) -> Result<Vec<Crop>, EmbedError> {
    let square = |mask| Ok(Crop::whole(preprocess.square(crop_of(image, mask)?.image())));
    masks.iter().enumerate().map(square).collect()
}

/// Returns a unit vector per crop, `[crops][dim]`; the first crop is that of mask `first`.
pub(crate) fn embed_crops(
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

/// Returns a unit vector per mask, `[masks][dim]`. `squares`: how crops become the encoder's squares, if they do.
/// `batch`: crops per call, the encoder's preference if `None`. Batches depend on the masks alone, so that models whose
/// vectors vary with the batch (8-bit ones with scales found at run time) agree on every machine. Memory:
/// [`batch_bytes`].
pub fn embed_masks(
    image: &RgbImage,
    masks: &[Mask],
    squares: Option<&Preprocess>,
    encoder: &mut dyn ImageEncoder,
    batch: Option<NonZeroUsize>,
) -> Result<Vec<f32>, EmbedError> {
    let batch = batch.map_or(encoder.preferred_batch(), NonZeroUsize::get);
    let mut vectors = Vec::with_capacity(masks.len() * encoder.dim());
    let mut crops = Vec::new();
    let mut n_pixels = 0;
    for (index, mask) in masks.iter().enumerate() {
        let crop = crop_of(image, (index, mask))?;
        match squares {
            Some(preprocess) => crops.push(Crop::whole(preprocess.square(crop.image()))),
            None => {
                n_pixels += mask.inside.n_px() as u64;
                crops.push(crop);
            }
        }
        if crops.len() >= batch || n_pixels >= MAX_BATCH_PIXELS || index + 1 == masks.len() {
            vectors.extend(embed_crops(&crops, index + 1 - crops.len(), encoder)?);
            crops.clear();
            n_pixels = 0;
        }
    }
    Ok(vectors)
}
