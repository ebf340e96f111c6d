//! Vectors of a photo's patches: of regions of their own, or a share of the vectors of masks.

use image::RgbImage;
use slag_models::ImageEncoder;

use super::EmbedError;
use crate::masks::{Mask, patches};

/// Share of a mask's vector that is the mean of the patches within it; the rest is its crop's. Chosen on the labelled house and
/// yard (docs/accuracy.md).
const SHARE: f32 = 0.5;

/// A photo whose patches have vectors, and what becomes of them.
pub struct PhotoPatches {
    photo: RgbImage,
    use_of: Use,
}

/// What becomes of the vectors.
enum Use {
    /// Each of these patches is a region with a vector of its own.
    Regions(Vec<usize>),
    /// Each mask takes a share of the patches within it: the share of its pixels in each.
    Masks(Vec<Vec<(usize, f32)>>),
}

impl PhotoPatches {
    /// Patches that are regions, by their numbers, row by row.
    pub fn regions(photo: RgbImage, numbers: Vec<usize>) -> Self {
        Self { photo, use_of: Use::Regions(numbers) }
    }

    /// Patches, `per_side` along each side of the photo, that masks take a share of.
    pub fn of_masks(photo: RgbImage, masks: &[Mask], per_side: u32) -> Self {
        let (width_px, height_px) = photo.dimensions();
        let shares = |mask| patches::shares(mask, per_side, width_px, height_px);
        let shares = masks.iter().map(shares).collect();
        Self { photo, use_of: Use::Masks(shares) }
    }

    /// Adds the vectors of regions to those of the crops, `[masks][dim]`, or mixes the patches into them; all are unit vectors.
    /// # Errors
    /// [`EmbedError::Patches`] where the encoder fails.
    pub fn add_to(&self, vectors: &mut Vec<f32>, encoder: &mut dyn ImageEncoder) -> Result<(), EmbedError> {
        let of_patches = encoder
            .encode_patches(&self.photo)
            .map_err(|cause| EmbedError::Patches { cause: Box::new(cause) })?
            .unwrap_or_default();
        let dim = encoder.dim();
        match &self.use_of {
            Use::Regions(numbers) => {
                let chosen = numbers.iter().filter_map(|&k| of_patches.get(k * dim..(k + 1) * dim));
                vectors.extend(chosen.flatten());
            }
            Use::Masks(shares) => {
                for (vector, shares) in vectors.chunks_exact_mut(dim).zip(shares) {
                    mix(vector, shares, &of_patches);
                }
            }
        }
        Ok(())
    }
}

/// Mixes the direction of the mean of patches into a unit vector, which remains one. A mean without a direction changes nothing.
fn mix(vector: &mut [f32], shares: &[(usize, f32)], of_patches: &[f32]) {
    let dim = vector.len();
    let mut mean = vec![0.0; dim];
    for &(patch, share) in shares {
        let Some(of_patch) = of_patches.get(patch * dim..(patch + 1) * dim) else { continue };
        mean.iter_mut().zip(of_patch).for_each(|(sum, x)| *sum += share * x);
    }
    let length = |x: &[f32]| x.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt() as f32;
    let of_mean = length(&mean);
    if of_mean < f32::EPSILON {
        return;
    }
    let mixed: Vec<f32> =
        vector.iter().zip(&mean).map(|(x, m)| (1.0 - SHARE) * x + SHARE * m / of_mean).collect();
    let of_mixed = length(&mixed);
    if of_mixed >= f32::EPSILON {
        vector.iter_mut().zip(mixed).for_each(|(x, mixed)| *x = mixed / of_mixed);
    }
}
