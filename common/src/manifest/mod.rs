//! The manifest: the signed list of a scene's shards.
//!
//! On disk and on the wire it is one ASCII line, `slag-manifest 1 ed25519 PUBLIC_KEY SIGNATURE\n` (hex), followed by the
//! JSON text. The signature covers that text byte for byte, so no two readers can disagree on it. The same scene gives
//! the same JSON: fields in declaration order, no spaces.

mod error;
mod index;
mod records;
mod signature;
#[cfg(test)]
mod tests;

pub use error::ManifestError;
pub use index::CellIndex;
pub use records::{
    Calibration, CellRecord, EncoderRecord, MAX_BYTES, Manifest, ShardRecord, TARGET, VERSION,
};
pub use signature::{TrustedKeys, generate_key};
