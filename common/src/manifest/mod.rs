//! The manifest: the list of a scene's shards.
//!
//! JSON on disk and on the wire. The same scene gives the same bytes: fields in declaration order, no spaces. It is a
//! target of the store's metadata ([`crate::tuf`]), which proves that it is genuine and the newest.

mod index;
mod json;
mod records;
#[cfg(test)]
mod tests;

pub use index::CellIndex;
pub use json::ManifestError;
pub use records::{
    Calibration, CellRecord, EncoderRecord, MAX_BYTES, MAX_TEXT_FILES, Manifest, ObjectRecord, ShardRecord,
    TARGET, TextModelRecord, VERSION,
};
