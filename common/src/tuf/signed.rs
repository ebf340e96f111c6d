//! Signed metadata: parsing, the threshold of signatures, signing.

use std::collections::{BTreeMap, BTreeSet};

use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::canonical::canonical_json;
use super::error::TufError;
use super::metadata::{Body, Key, RoleKeys};
use super::time::{format_utc, parse_utc};

/// The members that all metadata has.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Head {
    #[serde(rename = "_type")]
    pub kind: String,
    pub spec_version: String,
    /// Version of the metadata, from 1.
    pub version: u64,
    /// Time from which it is refused, UTC.
    pub expires: String,
}

/// A signature in metadata.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct MetadataSignature {
    /// Id of the key.
    pub keyid: String,
    /// Signature, hex.
    pub sig: String,
}

/// A signed document of The Update Framework.
#[derive(Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "Metadata")]
pub struct Envelope {
    /// Signatures of its canonical form.
    signatures: Vec<MetadataSignature>,
    /// What is signed.
    #[schemars(with = "Map<String, Value>")]
    signed: Value,
}

/// Metadata whose form is checked; its signatures are checked by [`SignedMetadata::check_signatures`].
#[derive(Clone, Debug)]
pub struct SignedMetadata<T> {
    pub head: Head,
    /// Seconds since 1970 from which it is refused.
    pub expires_unix_secs: u64,
    pub body: T,
    signatures: Vec<MetadataSignature>,
    canonical: Vec<u8>,
}

impl<T: Body> SignedMetadata<T> {
    /// Parses metadata; `role` is for messages.
    pub fn parse(role: &str, bytes: &[u8]) -> Result<Self, TufError> {
        let refuse = |what: String| TufError::Format { role: role.to_owned(), what };
        let Envelope { signatures, signed } =
            serde_json::from_slice(bytes).map_err(|e| refuse(in_place_of_json(bytes, &e)))?;
        let canonical = canonical_json(&signed).map_err(refuse)?;
        let head = Head::deserialize(&signed).map_err(|e| refuse(e.to_string()))?;
        if head.kind != T::TYPE {
            return Err(refuse(format!("its _type is {:?}, expected {:?}", head.kind, T::TYPE)));
        }
        if head.spec_version.split('.').next() != Some("1") {
            return Err(refuse(format!("its spec_version is {:?}, expected 1.x", head.spec_version)));
        }
        if head.version == 0 {
            return Err(refuse("its version is 0, expected 1 or more".into()));
        }
        let expires_unix_secs = parse_utc(&head.expires)
            .ok_or_else(|| refuse(format!("expires is {:?}, expected YYYY-MM-DDTHH:MM:SSZ", head.expires)))?;
        let mut signers = BTreeSet::new();
        if let Some(twice) = signatures.iter().find(|signature| !signers.insert(&signature.keyid)) {
            return Err(refuse(format!("key {} signed it twice", twice.keyid)));
        }
        let body = T::deserialize(&signed).map_err(|e| refuse(e.to_string()))?;
        body.check().map_err(refuse)?;
        Ok(Self { head, expires_unix_secs, body, signatures, canonical })
    }

    pub fn check_signatures(
        &self,
        role: &str,
        keys: &BTreeMap<String, Key>,
        role_keys: &RoleKeys,
    ) -> Result<(), TufError> {
        let mut signers = BTreeSet::new();
        for signature in &self.signatures {
            if !role_keys.keyids.contains(&signature.keyid) {
                continue;
            }
            let Some(key) = keys.get(&signature.keyid).and_then(Key::verifying_key) else { continue };
            if is_signed(&key, &self.canonical, &signature.sig) {
                // By public key: one key under two ids is one signer.
                signers.insert(key.to_bytes());
            }
        }
        match signers.len() >= role_keys.threshold as usize {
            true => Ok(()),
            false => Err(TufError::Signatures {
                role: role.to_owned(),
                found: signers.len(),
                threshold: role_keys.threshold,
            }),
        }
    }

    pub fn check_expiry(&self, role: &str, now_unix_secs: u64) -> Result<(), TufError> {
        match self.expires_unix_secs <= now_unix_secs {
            true => Err(TufError::Expired {
                role: role.to_owned(),
                expired: self.head.expires.clone(),
                now: format_utc(now_unix_secs),
            }),
            false => Ok(()),
        }
    }
}

/// Signs metadata; the same content and keys give the same bytes.
pub fn sign<T: Body>(version: u64, expires_unix_secs: u64, body: &T, keys: &[&SigningKey]) -> Vec<u8> {
    let head = Head {
        kind: T::TYPE.into(),
        spec_version: super::SPEC_VERSION.into(),
        version,
        expires: format_utc(expires_unix_secs),
    };
    let mut signed = serde_json::to_value(head).expect("a head is JSON");
    let body = serde_json::to_value(body).expect("a body is JSON");
    if let (Value::Object(signed), Value::Object(body)) = (&mut signed, body) {
        signed.extend(body);
    }
    let canonical = canonical_json(&signed).expect("our metadata holds whole numbers only");
    let mut signatures: Vec<MetadataSignature> = keys
        .iter()
        .map(|key| MetadataSignature {
            keyid: Key::of(key).id(),
            sig: hex::encode(key.sign(&canonical).to_bytes()),
        })
        .collect();
    signatures.sort_by(|a, b| a.keyid.cmp(&b.keyid));
    signatures.dedup();
    serde_json::to_vec(&Envelope { signatures, signed }).expect("metadata is JSON")
}

/// Names what was received instead of JSON, if its first bytes tell.
fn in_place_of_json(bytes: &[u8], error: &serde_json::Error) -> String {
    match bytes.trim_ascii_start() {
        [b'<', ..] => "a web page came in its place, such as a network's log-in".into(),
        [0x1f, 0x8b, ..] => "it came packed with gzip, as a proxy on the way may do".into(),
        _ => error.to_string(),
    }
}

/// Adds missing signatures of these keys.
pub fn add_signatures(role: &str, bytes: &[u8], keys: &[SigningKey]) -> Result<Vec<u8>, TufError> {
    let refuse = |what: String| TufError::Format { role: role.to_owned(), what };
    let Envelope { mut signatures, signed } =
        serde_json::from_slice(bytes).map_err(|e| refuse(e.to_string()))?;
    let canonical = canonical_json(&signed).map_err(refuse)?;
    for key in keys {
        let keyid = Key::of(key).id();
        if signatures.iter().all(|signature| signature.keyid != keyid) {
            let sig = hex::encode(key.sign(&canonical).to_bytes());
            signatures.push(MetadataSignature { keyid, sig });
        }
    }
    signatures.sort_by(|a, b| a.keyid.cmp(&b.keyid));
    Ok(serde_json::to_vec(&Envelope { signatures, signed }).expect("metadata is JSON"))
}

pub fn generate_key() -> SigningKey {
    SigningKey::generate(&mut rand_core::OsRng)
}

pub(super) fn is_signed(key: &VerifyingKey, message: &[u8], signature_hex: &str) -> bool {
    let mut bytes = [0; 64];
    // Strict verification refuses small-order keys, which have several valid signatures (RFC 8032, 5.1.7).
    hex::decode_to_slice(signature_hex, &mut bytes).is_ok()
        && key.verify_strict(message, &Signature::from_bytes(&bytes)).is_ok()
}
