//! Masks that the photo's edge cuts off count less.

use super::settings::LEAST_MASK_WEIGHT;
use crate::lift::photos::{MaskOutline, Photo};

/// Returns the weight of each mask of some photos: (1 - truncation)^power.
pub(super) fn mask_weights(photos: &[Photo], power: f32) -> Vec<f32> {
    let weight = |outline: &MaskOutline| outline.uncut_share().max(LEAST_MASK_WEIGHT).powf(power);
    photos.iter().flat_map(|photo| &photo.outlines).map(weight).collect()
}
