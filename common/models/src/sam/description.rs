//! `model.toml` of a segmenter.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::ModelError;
use crate::description::{FileRef, check_common, read_toml, require};

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamDescription {
    pub name: String,
    /// Strengths and limits, for people.
    #[serde(default)]
    pub about: String,
    pub licence: String,
    /// Folder of the files, relative to the description's folder.
    #[serde(default = "crate::description::here")]
    pub files_root: PathBuf,
    pub segment: SegmentDescription,
}

#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SegmenterKind {
    /// Segment Anything: the photo keeps its proportions in the square; one feature map.
    Sam,
    /// Segment Anything 2 and its kin: the photo is stretched over the square; three feature maps.
    Sam2,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SegmentDescription {
    pub kind: SegmenterKind,
    /// The model from an image to its embedding.
    pub image_encoder: FileRef,
    /// The model from points and the embedding to masks.
    pub mask_decoder: FileRef,
    /// Edge length of the encoder's input square, in pixels.
    #[serde(default = "sam_size_px")]
    pub size_px: u16,
    /// Subtracted from level / 255, per channel.
    #[serde(default = "imagenet_mean")]
    pub mean: [f64; 3],
    /// Divisor after the subtraction, per channel.
    #[serde(default = "imagenet_std")]
    pub std: [f64; 3],
}

fn sam_size_px() -> u16 {
    1024
}

fn imagenet_mean() -> [f64; 3] {
    [0.485, 0.456, 0.406]
}

fn imagenet_std() -> [f64; 3] {
    [0.229, 0.224, 0.225]
}

impl SamDescription {
    pub fn read(path: &Path) -> Result<Self, ModelError> {
        let description: Self = read_toml(path)?;
        check_common(path, &description.name, &description.files_root, &description.files())?;
        let SegmentDescription { size_px, mean, std, .. } = &description.segment;
        require(path, (64..=2048).contains(size_px), "segment.size_px", size_px, "64 to 2048")?;
        let is_finite = mean.iter().all(|x| x.is_finite());
        require(path, is_finite, "segment.mean", mean, "three finite numbers")?;
        let is_positive = std.iter().all(|x| x.is_finite() && *x > 0.0);
        require(path, is_positive, "segment.std", std, "three numbers above 0")?;
        Ok(description)
    }

    /// Files with their roles, each followed by separate weights.
    pub fn files(&self) -> Vec<(&'static str, &FileRef)> {
        let SegmentDescription { image_encoder, mask_decoder, .. } = &self.segment;
        let both = [("segment.image_encoder", image_encoder), ("segment.mask_decoder", mask_decoder)];
        both.into_iter().flat_map(|(role, file)| file.parts().map(move |part| (role, part))).collect()
    }
}
