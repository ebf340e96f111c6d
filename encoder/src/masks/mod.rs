//! Masks of an image, and the partition of the image into regions.

mod labels;
mod mask;
mod overlay;
pub mod patches;
pub mod regions;
pub mod rle;
pub mod windows;

pub use labels::masks_of_labels;
pub use mask::{BoxPx, Mask};
pub use overlay::overlay;
pub use regions::{NO_REGION, RegionMap};
