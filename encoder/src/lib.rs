//! The cloud side of SLAG as a library: one module per stage of the pipeline.
//!
//! [`encode::encode`] runs all stages. This example encodes a generated room, with the encoder and the segmenter
//! that need no ONNX Runtime:
//!
//! ```
//! use slag_encoder::encode::{self, EncodeSettings, Engines, Masks};
//! use slag_encoder::{progress::Silent, raster::CpuRasterizer};
//! use slag_lab::generate::{Scene, grammar};
//! use slag_models::{ModelDir, SessionOptions};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let folder = tempfile::tempdir()?;
//! let mut room = Scene::new(&[grammar::SceneKind::Room], 1, 3);
//! let files = room.write(folder.path(), &Silent)?;
//!
//! let mut settings = EncodeSettings::new(files.scene, files.views, folder.path().join("store"), true);
//! settings.view.masks = Masks::Graph;
//! let (models, session) = (ModelDir::colours(), SessionOptions::new("".into()));
//! let engines = Engines::new(&models, &session, &CpuRasterizer);
//! let summary = encode::encode(&settings, &engines, &Silent, &false.into())?;
//!
//! assert_eq!((summary.generation, summary.n_views), (1, 3));
//! assert!(summary.n_masks > 0 && summary.n_without_evidence < summary.n_gaussians);
//! # Ok(())
//! # }
//! ```

#[cfg(feature = "fleet")]
pub(crate) mod blobs;
pub mod cells;
pub mod check;
pub mod cli;
pub mod codebook;
pub(crate) mod diff;
pub mod embed;
pub mod encode;
#[cfg(feature = "fleet")]
pub(crate) mod fleet;
pub(crate) mod ground;
mod html;
pub mod ingest;
pub mod landmarks;
mod lanes;
pub mod lift;
pub mod masks;
mod memory;
pub mod objects;
pub mod occupancy;
pub mod progress;
pub mod publish;
pub mod query;
pub mod raster;
pub(crate) mod report;
pub mod segment;
pub mod shard;
pub mod store;
pub(crate) mod view;
pub mod viewpoints;
