//! The store's keys: the one that signs, and, while a change of keys is under way, the one that will.
//!
//! | file | what |
//! |---|---|
//! | `keys/ed25519`, `.pub` | signing key (mode 0600), and its public half |
//! | `keys/ed25519.next`, `.next.pub` | the same of its successor, while there is one |
//! | `keys/ed25519.previous.pub` | public half of its predecessor: it signed `manifest.previous` |

use std::io;
use std::path::Path;

use ed25519_dalek::SigningKey;
use serde::Serialize;
use slag_common::Hash32;
use slag_common::manifest::{self, Manifest, TrustedKeys};

use super::error::StoreError;
use super::files::{self, Access};
use super::signed;

const SECRET: &str = "keys/ed25519";
const PUBLIC: &str = "keys/ed25519.pub";
pub(super) const NEXT_SECRET: &str = "keys/ed25519.next";
pub(super) const NEXT_PUBLIC: &str = "keys/ed25519.next.pub";
const PREVIOUS_PUBLIC: &str = "keys/ed25519.previous.pub";

/// The public keys of a store.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct PublicKeys {
    /// The one that signs.
    pub present: Hash32,
    /// The one that will sign, while a change is under way.
    pub next: Option<Hash32>,
    /// The one that signed before.
    pub previous: Option<Hash32>,
}

impl PublicKeys {
    /// Reads the public keys of a store; needs no lock.
    ///
    /// # Errors
    /// [`StoreError::Io`] if there is no key yet, [`StoreError::Key`] for a damaged file.
    pub fn read(dir: &Path) -> Result<Self, StoreError> {
        // In this order a reader beside a writer that moves them misses none.
        let (next, previous) = (read_if_there(dir, NEXT_PUBLIC)?, read_if_there(dir, PREVIOUS_PUBLIC)?);
        let present = signed::read_hex_key(&dir.join(PUBLIC))?;
        Ok(Self { present, next: next.filter(|next| *next != present), previous })
    }

    /// Returns whose manifests this store's readers take for its own.
    pub(super) fn trusted(self) -> TrustedKeys {
        TrustedKeys::Only([Some(self.present), self.next, self.previous].into_iter().flatten().collect())
    }
}

/// The secret keys, with the writer.
#[derive(Debug)]
pub(super) struct Keys {
    pub present: SigningKey,
    pub next: Option<SigningKey>,
}

impl Keys {
    /// Reads the signing keys, or makes the first one; finishes a change of keys that a crash cut off.
    pub fn load_or_make(dir: &Path) -> Result<Self, StoreError> {
        let present = match read_secret(dir, SECRET)? {
            Some(key) => key,
            None => make(dir, SECRET)?,
        };
        let mut keys = Self { present, next: read_secret(dir, NEXT_SECRET)? };
        write_public(dir, PUBLIC, public(&keys.present))?;
        match &keys.next {
            Some(next) => write_public(dir, NEXT_PUBLIC, public(next))?,
            None => remove_if_there(dir, NEXT_PUBLIC)?,
        }
        let signed = signed::read_signed(&dir.join(signed::MANIFEST))?;
        if let (Some(next), Some(signed)) = (&keys.next, signed)
            && Manifest::verify(&signed, &TrustedKeys::Only(vec![public(next)])).is_ok()
        {
            keys.promote(dir)?;
        }
        Ok(keys)
    }

    /// Puts the next key in the present one's place.
    pub(super) fn promote(&mut self, dir: &Path) -> Result<(), StoreError> {
        let Some(next) = self.next.take() else { return Ok(()) };
        write_public(dir, PREVIOUS_PUBLIC, public(&self.present))?;
        files::move_into_place(&dir.join(NEXT_SECRET), &dir.join(SECRET))?;
        write_public(dir, PUBLIC, public(&next))?;
        remove_if_there(dir, NEXT_PUBLIC)?;
        self.present = next;
        Ok(())
    }
}

/// Returns a key's public half.
pub(super) fn public(key: &SigningKey) -> Hash32 {
    Hash32(key.verifying_key().to_bytes())
}

pub(super) fn make(dir: &Path, name: &str) -> Result<SigningKey, StoreError> {
    let key = manifest::generate_key();
    let text = format!("{}\n", hex::encode(key.to_bytes()));
    files::replace(&part(dir), &dir.join(name), text.as_bytes(), Access::Private)?;
    Ok(key)
}

fn read_secret(dir: &Path, name: &str) -> Result<Option<SigningKey>, StoreError> {
    Ok(read_if_there(dir, name)?.map(|secret| SigningKey::from_bytes(&secret.0)))
}

fn read_if_there(dir: &Path, name: &str) -> Result<Option<Hash32>, StoreError> {
    match signed::read_hex_key(&dir.join(name)) {
        Err(StoreError::Io(e)) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        read => read.map(Some),
    }
}

pub(super) fn write_public(dir: &Path, name: &str, key: Hash32) -> Result<(), StoreError> {
    let (text, path) = (format!("{key}\n"), dir.join(name));
    if fs_err::read(&path).ok().as_deref() != Some(text.as_bytes()) {
        files::replace(&part(dir), &path, text.as_bytes(), Access::Shared)?;
    }
    Ok(())
}

fn remove_if_there(dir: &Path, name: &str) -> Result<(), StoreError> {
    match fs_err::remove_file(dir.join(name)) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        removed => Ok(removed?),
    }
}

fn part(dir: &Path) -> std::path::PathBuf {
    dir.join("tmp").join("key.part")
}
