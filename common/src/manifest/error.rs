//! Reasons to refuse a manifest.

use super::records::{MAX_BYTES, VERSION};
use crate::hash::Hash32;

/// Why a manifest is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ManifestError {
    /// Longer than [`MAX_BYTES`].
    #[error(
        "the manifest has {len_bytes} bytes, expected at most {MAX_BYTES}: this is not a slag manifest; check the address"
    )]
    TooLong {
        /// Length found.
        len_bytes: u64,
    },
    /// The first line is invalid.
    #[error(
        "line 1: {what}; expected `slag-manifest 1 ed25519 PUBLIC_KEY SIGNATURE`; check that the address is that of a slag-encoder store"
    )]
    Envelope {
        /// The fault.
        what: String,
    },
    /// The signing key is not accepted.
    #[error(
        "the manifest is signed by key {found}, accepted: {accepted}; if the store's key was changed, name the accepted key and the new one once: `slag-edge fetch --key OLD --key NEW`"
    )]
    UnknownKey {
        /// The key found.
        found: Hash32,
        /// The keys accepted, separated by spaces.
        accepted: String,
    },
    /// The signature does not match the bytes.
    #[error("the signature does not match the manifest: it was changed in transit; fetch again")]
    Signature,
    /// The signed text is not a manifest.
    #[error(
        "the signed text is not a manifest of version {VERSION}: {what}; use a robot program and an encoder of matching versions"
    )]
    Content {
        /// The fault.
        what: String,
    },
    /// The manifest has expired.
    #[error(
        "the manifest expired at {expired_unix_secs} s since 1970, and the clock says {now_unix_secs}; check the clock, or publish the scene again"
    )]
    Expired {
        /// Time of expiry, seconds since 1970.
        expired_unix_secs: u64,
        /// Current time, seconds since 1970.
        now_unix_secs: u64,
    },
}
