//! `model.toml` of a segmenter.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::description::{DescriptionError, FileRef, check_common, read_toml, require};

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

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum SegmentDescription {
    /// Segment Anything: the photo keeps its proportions in the square; one feature map.
    Sam(SamFiles),
    /// Segment Anything 2 and its kin: the photo is stretched over the square; three feature maps.
    Sam2(SamFiles),
}

impl SegmentDescription {
    pub fn files(&self) -> &SamFiles {
        match self {
            Self::Sam(files) | Self::Sam2(files) => files,
        }
    }

    pub fn is_stretched(&self) -> bool {
        matches!(self, Self::Sam2(_))
    }
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamFiles {
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
    pub fn read(path: &Path) -> Result<Self, DescriptionError> {
        let description: Self = read_toml(path)?;
        check_common(path, &description.name, &description.files_root, &description.files())?;
        let sam = description.segment.files();
        let (size_px, expected) = (sam.size_px, "64 to 2048");
        require(path, (64..=2048).contains(&size_px), "segment.size_px", size_px.to_string(), expected)?;
        let finite = sam.mean.iter().all(|x| x.is_finite());
        require(path, finite, "segment.mean", format!("{:?}", sam.mean), "three finite numbers")?;
        let positive = sam.std.iter().all(|x| x.is_finite() && *x > 0.0);
        require(path, positive, "segment.std", format!("{:?}", sam.std), "three numbers above 0")?;
        Ok(description)
    }

    /// Files with their roles, each followed by separate weights.
    pub fn files(&self) -> Vec<(&'static str, &FileRef)> {
        let files = self.segment.files();
        let both =
            [("segment.image_encoder", &files.image_encoder), ("segment.mask_decoder", &files.mask_decoder)];
        both.into_iter().flat_map(|(role, file)| file.parts().map(move |part| (role, part))).collect()
    }
}
