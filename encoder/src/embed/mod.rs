//! Embedding: a crop for each mask, and a vector for each crop.

mod shared;

use std::num::NonZeroUsize;

use image::{Rgb, RgbImage, imageops};
use slag_models::preprocess::Preprocess;
use slag_models::{Crop, ImageEncoder, InferenceError};

use crate::masks::patches::{self, Windows};
use crate::masks::{BoxPx, Mask};

pub(crate) use shared::{Failure, SharedEncoders};

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

/// Share of the patches' or windows' mean in a mask's vector; the rest is the crop's. Chosen on the labelled house and
/// yard (docs/decisions.md).
const SHARE_OF_PATCHES: f32 = 0.5;
const SHARE_OF_WINDOWS: f32 = 0.35;

/// Shares of a photo's vectors in its masks.
pub(crate) struct Surroundings {
    share: f32,
    /// `[masks]`: indices of the photo's vectors, each with its share of the mean.
    of_mask: Vec<Vec<(usize, f32)>>,
}

impl Surroundings {
    /// Weighs the photo's patches, `per_side` along each side, by the mask's pixels in them.
    pub(crate) fn of_patches(masks: &[Mask], per_side: u32, (width_px, height_px): (u32, u32)) -> Self {
        let shares = |mask| patches::shares(mask, per_side, width_px, height_px);
        Self { share: SHARE_OF_PATCHES, of_mask: masks.iter().map(shares).collect() }
    }

    /// Weighs windows by the mask's pixels in them; every size of windows counts the same.
    pub(crate) fn of_windows(masks: &[Mask], windows: &Windows) -> Self {
        let shares = |mask| windows.shares(mask);
        Self { share: SHARE_OF_WINDOWS, of_mask: masks.iter().map(shares).collect() }
    }

    pub fn n_masks(&self) -> usize {
        self.of_mask.len()
    }

    /// Mixes the direction of each mask's mean of `of_photo`, `[vectors][dim]`, into its unit vector of `of_masks`,
    /// `[masks][dim]`, which stays unit. A mean without a direction changes nothing.
    pub(crate) fn mix(&self, of_masks: &mut [f32], of_photo: &[f32], dim: usize) {
        for (vector, shares) in of_masks.chunks_exact_mut(dim.max(1)).zip(&self.of_mask) {
            let mut mean = vec![0.0; dim];
            for &(k, share) in shares {
                let Some(seen) = of_photo.get(k * dim..(k + 1) * dim) else { continue };
                mean.iter_mut().zip(seen).for_each(|(sum, x)| *sum += share * x);
            }
            let Some(mean) = unit(&mean) else { continue };
            let mixed: Vec<f32> =
                vector.iter().zip(mean).map(|(x, m)| (1.0 - self.share) * x + self.share * m).collect();
            if let Some(mixed) = unit(&mixed) {
                vector.copy_from_slice(&mixed);
            }
        }
    }
}

/// `None` for a vector without a direction.
fn unit(vector: &[f32]) -> Option<Vec<f32>> {
    let length = vector.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt() as f32;
    (length >= f32::EPSILON).then(|| vector.iter().map(|x| x / length).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::masks::BoxPx;

    /// Oracle: the definition in float64, pixel by pixel.
    #[test]
    fn a_mask_takes_a_share_of_what_its_pixels_see() {
        let (size_px, per_side, dim) = ((30, 21), 4, 3);
        let box_px = BoxPx { x0: 3, y0: 2, x1: 23, y1: 20 };
        let mask = Mask::within(box_px, |x, y| (x + 20 * y) % 7 < 4);
        let units = |n: usize| -> Vec<f32> {
            let component = |k: usize| (k * 37 % 101) as f32 - 50.3;
            (0..n)
                .flat_map(|k| unit(&[3 * k, 3 * k + 1, 3 * k + 2].map(component)).expect("a length"))
                .collect()
        };
        let windows = Windows::new(&[1, 2, 4], size_px.0, size_px.1);
        let (crop, of_patches, of_windows) = (units(1), units(16), units(windows.masks().len()));

        let mut by_patch = [0.0; 3];
        let mut by_window = [0.0; 3];
        for (x, y) in (0..size_px.0)
            .flat_map(|x| (0..size_px.1).map(move |y| (x, y)))
            .filter(|&(x, y)| mask.contains(x, y))
        {
            let at =
                |x: u32, edge: u32| ((f64::from(x) + 0.5) * f64::from(per_side) / f64::from(edge)) as usize;
            let patch = at(y, size_px.1) * per_side as usize + at(x, size_px.0);
            (0..dim).for_each(|d| by_patch[d] += f64::from(of_patches[patch * dim + d]));
            let mut first = 0;
            for size in [1u32, 2, 4] {
                // Windows of this size with the pixel: each covers two by two cells half a window wide.
                let n = 2 * size - 1;
                let cell =
                    |x: u32, edge: u32| ((f64::from(x) + 0.5) * f64::from(2 * size) / f64::from(edge)) as u32;
                let (column, row) = (cell(x, size_px.0), cell(y, size_px.1));
                let over: Vec<u32> = (0..n * n)
                    .filter(|k| (k % n..k % n + 2).contains(&column) && (k / n..k / n + 2).contains(&row))
                    .collect();
                for k in &over {
                    let seen = &of_windows[(first + *k as usize) * dim..];
                    (0..dim).for_each(|d| by_window[d] += f64::from(seen[d]) / over.len() as f64);
                }
                first += (n * n) as usize;
            }
        }
        let masks = [mask];
        let patches = Surroundings::of_patches(&masks, per_side, size_px);
        let windows = Surroundings::of_windows(&masks, &windows);
        for (surroundings, of_photo, mean, share) in
            [(patches, &of_patches, by_patch, 0.5), (windows, &of_windows, by_window, 0.35)]
        {
            assert_eq!(surroundings.n_masks(), 1);
            let mut mixed = crop.clone();
            surroundings.mix(&mut mixed, of_photo, dim);
            let length = |x: [f64; 3]| x.iter().map(|x| x * x).sum::<f64>().sqrt();
            let expected: [f64; 3] =
                std::array::from_fn(|d| (1.0 - share) * f64::from(crop[d]) + share * mean[d] / length(mean));
            for d in 0..dim {
                let error = (f64::from(mixed[d]) - expected[d] / length(expected)).abs();
                assert!(error < 1e-6, "{mixed:?} {expected:?}");
            }
        }
    }

    #[test]
    fn what_has_no_direction_changes_nothing() {
        let of = |shares| Surroundings { share: 0.5, of_mask: vec![shares] };
        let mut vector = vec![0.6, 0.8];
        of(vec![(0, 0.5), (1, 0.5)]).mix(&mut vector, &[1.0, 0.0, -1.0, 0.0], 2);
        assert_eq!(vector, [0.6, 0.8]);
        of(vec![(0, 1.0)]).mix(&mut vector, &[-0.6, -0.8], 2);
        assert_eq!(vector, [0.6, 0.8]);
    }
}
