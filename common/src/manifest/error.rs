//! Reasons to refuse a manifest.

use super::records::{MAX_BYTES, VERSION};

/// Why a manifest is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ManifestError {
    #[error(
        "the manifest has {len_bytes} bytes, expected at most {MAX_BYTES}: this is not a slag manifest; check the address"
    )]
    TooLong { len_bytes: u64 },
    #[error(
        "the text is not a manifest of version {VERSION}: {what}; use a robot program and an encoder of matching versions"
    )]
    Content { what: String },
}
