//! Public keys of metadata.

use std::collections::BTreeMap;

use ed25519_dalek::{Signature, SigningKey, VerifyingKey};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::canonical::canonical_json;

const ED25519: &str = "ed25519";

/// A public key as metadata lists it. Only Ed25519 keys can verify; others are kept and never count.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Key {
    pub keytype: String,
    pub scheme: String,
    /// The key's values; `public` is the public key in hex.
    pub keyval: BTreeMap<String, Value>,
}

impl Key {
    /// Returns the public half of a signing key.
    pub fn of(key: &SigningKey) -> Self {
        let public = hex::encode(key.verifying_key().to_bytes());
        let keyval = BTreeMap::from([("public".to_owned(), Value::String(public))]);
        Self { keytype: ED25519.into(), scheme: ED25519.into(), keyval }
    }

    /// Returns the key's id: the SHA-256 of its canonical form, in hex.
    pub fn id(&self) -> String {
        let value = json!({ "keytype": self.keytype, "scheme": self.scheme, "keyval": self.keyval });
        // A value that is no text makes the key useless, not the id wrong: no such key verifies.
        let canonical = canonical_json(&value).unwrap_or_default();
        hex::encode(Sha256::digest(canonical))
    }

    /// Returns the Ed25519 public key; `None` for another kind or an invalid point.
    pub(super) fn verifying_key(&self) -> Option<VerifyingKey> {
        if self.keytype != ED25519 || self.scheme != ED25519 {
            return None;
        }
        let mut bytes = [0; 32];
        hex::decode_to_slice(self.keyval.get("public")?.as_str()?, &mut bytes).ok()?;
        VerifyingKey::from_bytes(&bytes).ok()
    }
}

/// Generates a signing key from the system's randomness.
pub fn generate_key() -> SigningKey {
    SigningKey::generate(&mut rand_core::OsRng)
}

pub(super) fn is_signed(key: &VerifyingKey, message: &[u8], signature_hex: &str) -> bool {
    let mut bytes = [0; 64];
    // Strict verification refuses small-order keys, which have several valid signatures (RFC 8032, 5.1.7).
    hex::decode_to_slice(signature_hex, &mut bytes).is_ok()
        && key.verify_strict(message, &Signature::from_bytes(&bytes)).is_ok()
}
