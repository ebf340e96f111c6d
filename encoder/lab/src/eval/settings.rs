//! Settings of an evaluation.

use clap::ValueEnum;
use serde::Serialize;
use slag_common::shard::Profile;

use super::filter::Filter;

/// What is scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum EvalKind {
    /// Each Gaussian by itself.
    Gaussians,
    /// Objects and the Gaussians within them; Gaussians without an object by themselves.
    Objects,
}

/// Settings of an evaluation.
#[derive(Clone, Debug, Default)]
pub struct EvalSettings {
    /// Words to query; all categories of the labels if empty.
    pub words: Vec<String>,
    /// Scores this profile's shards instead of the full field.
    pub profile: Option<Profile>,
    /// Lowest score of a match; the store's own by default.
    pub threshold: Option<f32>,
    /// How the Gaussians of a superpoint (of colour and shape) agree on an answer.
    pub filter: Option<Filter>,
    /// What is scored; by default objects, where the scene has them.
    pub kind: Option<EvalKind>,
    /// Scores each level of masks separately and takes the best (`slag_encoder::query::ByLevel`); full field only.
    pub by_mask_level: bool,
}

/// Negative queries: categories absent from most scenes. Those that a scene does have are left out.
pub const ABSENT: [&str; 24] = [
    "elephant",
    "airplane",
    "boat",
    "piano",
    "guitar",
    "horse",
    "cat",
    "bird",
    "fish",
    "snake",
    "banana",
    "pizza",
    "train",
    "helicopter",
    "bathtub",
    "toilet",
    "shower",
    "umbrella",
    "bicycle",
    "motorcycle",
    "tent",
    "ladder",
    "tractor",
    "traffic light",
];
