//! What a client remembers of a repository between updates.

use serde::{Deserialize, Serialize};

use super::error::TufError;
use super::metadata::{Body, Root, Timestamp};
use super::signed::SignedMetadata;
use super::time::parse_utc;

/// Metadata that was accepted, byte for byte. It is checked again whenever it is used, against the newest root.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Kept {
    pub root: String,
    pub timestamp: Option<String>,
    pub snapshot: Option<String>,
    /// The newest targets metadata: saves a download, and need not outlive the process, because the snapshot
    /// states its version.
    #[serde(skip)]
    pub targets: Option<String>,
}

impl Kept {
    /// Begins with a root that was trusted by hand.
    pub fn from_root(bytes: &[u8]) -> Result<Self, TufError> {
        parse_own_root(bytes)?;
        Ok(Self { root: text(Root::TYPE, bytes)?, timestamp: None, snapshot: None, targets: None })
    }

    pub fn root_version(&self) -> Option<u64> {
        SignedMetadata::<Root>::parse(Root::TYPE, self.root.as_bytes()).ok().map(|root| root.head.version)
    }

    /// Returns when the newest timestamp expires, seconds since 1970.
    pub fn expires_unix_secs(&self) -> Option<u64> {
        let bytes = self.timestamp.as_ref()?.as_bytes();
        Some(SignedMetadata::<Timestamp>::parse(Timestamp::TYPE, bytes).ok()?.expires_unix_secs)
    }

    /// Returns the time of signing that the newest timestamp states, seconds since 1970; it lies before its
    /// expiry.
    pub fn signed_unix_secs(&self) -> Option<u64> {
        let bytes = self.timestamp.as_ref()?.as_bytes();
        signed_unix_secs(&SignedMetadata::parse(Timestamp::TYPE, bytes).ok()?)
    }
}

/// Returns the time of signing that a timestamp states.
pub(super) fn signed_unix_secs(timestamp: &SignedMetadata<Timestamp>) -> Option<u64> {
    let signed = timestamp.body.signed_at.as_deref().and_then(parse_utc)?;
    (signed < timestamp.expires_unix_secs).then_some(signed)
}

/// Parses a root that is signed as it asks for itself.
pub(super) fn parse_own_root(bytes: &[u8]) -> Result<SignedMetadata<Root>, TufError> {
    let root = SignedMetadata::<Root>::parse(Root::TYPE, bytes)?;
    root.check_signatures(Root::TYPE, &root.body.keys, &root.body.roles[Root::TYPE])?;
    Ok(root)
}

/// Returns accepted metadata as text; JSON that was parsed is UTF-8.
pub(super) fn text(role: &str, bytes: &[u8]) -> Result<String, TufError> {
    String::from_utf8(bytes.to_vec())
        .map_err(|e| TufError::Format { role: role.to_owned(), what: e.to_string() })
}
