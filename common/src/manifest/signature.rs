//! Signs and verifies manifests.

use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};

use super::error::ManifestError;
use super::records::{MAX_BYTES, Manifest, VERSION};
use crate::frames::Aabb;
use crate::hash::Hash32;
use crate::shard::MAX_DIM;

/// The keys that may sign a manifest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TrustedKeys {
    /// Only these.
    Only(Vec<Hash32>),
    /// Any key: for the first contact, after which the caller keeps the key.
    FirstContact,
}

impl Manifest {
    /// Returns the signed form.
    pub fn sign(&self, key: &SigningKey) -> Vec<u8> {
        let json = serde_json::to_vec(self).expect("a manifest has no map with other keys than strings");
        let signature = key.sign(&json);
        let public = hex::encode(key.verifying_key().to_bytes());
        let mut out =
            format!("slag-manifest {VERSION} ed25519 {public} {}\n", hex::encode(signature.to_bytes()))
                .into_bytes();
        out.extend(json);
        out
    }

    /// Verifies a signed manifest and returns it with the key that signed it.
    ///
    /// # Errors
    /// [`ManifestError`]; call [`Manifest::check_expiry`] for the expiry.
    pub fn verify(bytes: &[u8], trusted: &TrustedKeys) -> Result<(Self, Hash32), ManifestError> {
        if bytes.len() as u64 > MAX_BYTES {
            return Err(ManifestError::TooLong { len_bytes: bytes.len() as u64 });
        }
        let envelope = |what: &str| ManifestError::Envelope { what: what.to_owned() };
        let end = bytes
            .iter()
            .take(512)
            .position(|b| *b == b'\n')
            .ok_or_else(|| envelope("no line end in 512 bytes"))?;
        let line = std::str::from_utf8(&bytes[..end]).map_err(|_| envelope("not ASCII"))?;
        let words: Vec<&str> = line.split(' ').collect();
        let ["slag-manifest", version, "ed25519", public, signature] = words[..] else {
            return Err(envelope(&format!("found {:?}", line.chars().take(40).collect::<String>())));
        };
        if version != VERSION.to_string() {
            return Err(envelope(&format!("version {version:?}")));
        }
        let public: Hash32 = public.parse().map_err(|_| envelope("the public key is not 64 hex digits"))?;
        let mut signature_bytes = [0; 64];
        hex::decode_to_slice(signature, &mut signature_bytes)
            .map_err(|_| envelope("the signature is not 128 hex digits"))?;
        if let TrustedKeys::Only(keys) = trusted
            && !keys.contains(&public)
        {
            let accepted = keys.iter().map(Hash32::to_string).collect::<Vec<_>>().join(" ");
            return Err(ManifestError::UnknownKey { found: public, accepted });
        }
        let key = VerifyingKey::from_bytes(&public.0)
            .map_err(|_| envelope("the public key is not an Ed25519 point"))?;
        let json = &bytes[end + 1..];
        // Strict verification refuses small-order keys, which have several valid signatures (RFC 8032, 5.1.7).
        key.verify_strict(json, &Signature::from_bytes(&signature_bytes))
            .map_err(|_| ManifestError::Signature)?;
        let manifest: Self =
            serde_json::from_slice(json).map_err(|e| ManifestError::Content { what: e.to_string() })?;
        manifest.check_content()?;
        if manifest.next_key == Some(public) {
            return Err(ManifestError::Content { what: "next_key is the key that signed it".into() });
        }
        Ok((manifest, public))
    }

    /// Checks the content, because the program of a key holder may be faulty too.
    fn check_content(&self) -> Result<(), ManifestError> {
        let refuse = |what: String| Err(ManifestError::Content { what });
        if self.version != VERSION {
            return refuse(format!("its version is {}", self.version));
        }
        if self.encoder.dim == 0 || self.encoder.dim as usize > MAX_DIM {
            return refuse(format!(
                "its embeddings have {} components, expected 1 to {MAX_DIM}",
                self.encoder.dim
            ));
        }
        if self.cells.windows(2).any(|pair| pair[0].cell_id >= pair[1].cell_id) {
            return refuse("its cell ids do not ascend".into());
        }
        for cell in &self.cells {
            let Aabb { min, max } = cell.bounds;
            if !(min.is_finite() && max.is_finite() && min.cmple(max).all()) {
                return refuse(format!(
                    "the box {min}..{max} of cell {} is empty or not finite",
                    cell.cell_id
                ));
            }
        }
        Ok(())
    }

    /// Checks the expiry against a clock.
    ///
    /// # Errors
    /// [`ManifestError::Expired`].
    pub fn check_expiry(&self, now_unix_secs: u64) -> Result<(), ManifestError> {
        match self.expires_unix_secs {
            Some(expired_unix_secs) if expired_unix_secs < now_unix_secs => {
                Err(ManifestError::Expired { expired_unix_secs, now_unix_secs })
            }
            _ => Ok(()),
        }
    }
}

/// Generates a signing key from the system's randomness.
pub fn generate_key() -> SigningKey {
    SigningKey::generate(&mut rand_core::OsRng)
}
