//! Vectors of a photo's patches: of regions of their own, or a share of the vectors of masks.

use image::RgbImage;
use slag_models::ImageEncoder;

use super::EmbedError;
use super::surroundings::Surroundings;

/// A photo to embed patch by patch, and how the vectors are used.
pub struct PhotoPatches {
    /// The photo.
    pub photo: RgbImage,
    /// How the vectors are used.
    pub uses: PatchUse,
}

/// How the vectors of patches are used.
pub enum PatchUse {
    /// Each of these patches is a region with a vector of its own; numbers row by row.
    Regions(Vec<usize>),
    /// Masks take a share.
    Masks(Surroundings),
}

impl PhotoPatches {
    /// Adds the vectors of regions to those of the crops, `[masks][dim]`, or mixes the patches into them; all are unit vectors.
    /// # Errors
    /// [`EmbedError::Patches`] where the encoder fails.
    pub fn add_to(&self, vectors: &mut Vec<f32>, encoder: &mut dyn ImageEncoder) -> Result<(), EmbedError> {
        let of_patches = encoder
            .encode_patches(&self.photo)
            .map_err(|cause| EmbedError::Patches { cause: Box::new(cause) })?
            .unwrap_or_default();
        let dim = encoder.dim();
        match &self.uses {
            PatchUse::Regions(numbers) => {
                let chosen = numbers.iter().filter_map(|&k| of_patches.get(k * dim..(k + 1) * dim));
                vectors.extend(chosen.flatten());
            }
            PatchUse::Masks(surroundings) => surroundings.mix(vectors, &of_patches, dim),
        }
        Ok(())
    }
}
