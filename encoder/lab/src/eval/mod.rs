//! Measures answers against labels.
//!
//! [`run`] encodes a scene with settings, and [`judge`] compares a store with labels: in three dimensions by
//! argmax over the categories' words, as the ScanNet protocol does (mIoU and mAcc; OpenGaussian, Wu et al. 2024),
//! and per word as retrieval (IoU at the threshold, average precision, area under the ROC curve). [`lerf`] and
//! [`scannet`] follow the protocols of public data sets; [`goal`] and [`relations`] ask the robot's program.

pub(crate) mod all;
pub(crate) mod defaults;
pub(crate) mod encoder;
pub(crate) mod goal;
mod instances;
pub(crate) mod judge;
pub(crate) mod lerf;
pub(crate) mod locate;
pub(crate) mod masks;
mod metrics;
pub(crate) mod names;
#[cfg(test)]
mod public_tests;
pub(crate) mod relations;
pub(crate) mod run;
pub(crate) mod scannet;
pub(crate) mod splat_only;
mod truth;
