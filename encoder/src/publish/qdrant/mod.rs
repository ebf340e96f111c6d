//! Pushes a scene's embeddings into Qdrant: one point a Gaussian.
//!
//! A collection holds one scene, or one cell of it ([`Layout`]). The id of a point is the Gaussian's index in the
//! input splat file. Its payload has `x`, `y`, `z` (world frame), `cell_id`, `scene`, `generation` and, if the
//! scene is geo-referenced, `location` (`lat`, `lon`).
//!
//! Each batch is acknowledged as applied before the next is sent, then recorded in the store, so that an
//! interrupted push continues there. Upserts by id are idempotent: a batch whose acknowledgement was lost
//! may be sent again.

mod collection;
mod database;
mod error;
mod index;
mod layout;
mod options;
mod points;
mod push;
mod record;
mod report;
mod snapshot;
mod source;

pub use error::PushError;
pub use index::{IndexSettings, Quantisation, SettingChange};
pub use layout::Layout;
pub use options::PushOptions;
pub use push::push;
pub use report::{PushProgress, PushReport};
pub use snapshot::Snapshot;
pub use source::{CellVectors, ExactShards, SourceError, VectorSource};

#[cfg(test)]
mod tests;
