//! Masks of an image, and the partition of the image into regions.

mod mask;
mod overlay;
pub mod patches;
pub mod regions;
pub mod rle;

pub use mask::Bits;
pub use mask::{BoxPx, Mask, NO_REGION, masks_of_labels};
pub use overlay::overlay;
pub use regions::RegionMap;
