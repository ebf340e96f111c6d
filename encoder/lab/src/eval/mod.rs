//! Measures answers against labels.
//!
//! Three ways: in three dimensions by argmax over the categories' words, as the ScanNet protocol does (mIoU and mAcc;
//! OpenGaussian, Wu et al. 2024); per word as retrieval (IoU at the threshold, average precision, area under the ROC
//! curve); and on held-out views as LERF does (Kerr et al. 2023): the scores are rendered, the best pixel must lie on the
//! thing (localisation), and the pixels above the threshold are compared with its mask.

pub mod defaults;
pub mod encoder;
mod error;
mod filter;
pub mod goal;
mod instances;
mod labelled;
mod labelled_scene;
pub mod lerf;
pub mod mask_noise;
pub mod metrics;
pub mod noise;
mod on_views;
mod own_best;
pub mod protocol;
#[cfg(test)]
mod public_tests;
pub mod relations;
mod report;
mod robot;
pub mod scan;
pub mod scannet;
mod settings;
mod truth;

pub use error::EvalError;
pub use filter::Filter;
pub use instances::{InstanceReport, Recall};
pub use labelled::labelled;
pub use labelled_scene::CompareError;
pub use report::{EvalReport, Subset, WordReport};
pub use settings::{EvalKind, EvalSettings};
pub use truth::{LabelledView, Thing, Truth, TruthError};
