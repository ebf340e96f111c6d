//! The signing keys of the metadata roles, and the folders in which they lie.
//!
//! | file | what |
//! |---|---|
//! | `keys/root/1.key` | root's key; nothing but a change of keys needs it, so it may be kept elsewhere |
//! | `keys/targets.key`, `keys/snapshot.key`, `keys/timestamp.key` | keys that sign what is published |
//!
//! All are 64 hex digits, mode 0600.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use ed25519_dalek::SigningKey;
use slag_common::manifest;
use slag_common::tuf::{Key, RoleKeys, Root};

use super::error::StoreError;
use super::files::{self, Access};
use super::signed;

/// The roles whose keys lie with the store.
const ONLINE: [&str; 3] = ["targets", "snapshot", "timestamp"];

/// Returns the folder of root's key, unless it was moved away.
pub(super) fn root_folder(store: &Path) -> PathBuf {
    store.join("keys").join("root")
}

/// Reads a role's key.
///
/// # Errors
/// [`StoreError::Io`] if it is not there, [`StoreError::Key`] for a damaged file.
pub(super) fn read(store: &Path, role: &str) -> Result<SigningKey, StoreError> {
    Ok(SigningKey::from_bytes(&signed::read_hex_key(&key_path(store, role))?.0))
}

/// Makes the keys of all roles that have none, and returns the body of a root that names them and root's key.
pub(super) fn make_all(store: &Path) -> Result<(Root, SigningKey), StoreError> {
    let folder = root_folder(store);
    files::ensure_folder(&store.join("keys"))?;
    files::ensure_folder(&folder)?;
    let mut roles = BTreeMap::new();
    let mut keys = BTreeMap::new();
    let mut add = |role: &str, key: &SigningKey| {
        let public = Key::of(key);
        roles.insert(role.to_owned(), RoleKeys { keyids: vec![public.id()], threshold: 1 });
        keys.insert(public.id(), public);
    };
    let root = read_or_make(&folder.join("1.key"))?;
    add("root", &root);
    for role in ONLINE {
        add(role, &read_or_make(&key_path(store, role))?);
    }
    Ok((Root { consistent_snapshot: true, keys, roles }, root))
}

fn key_path(store: &Path, role: &str) -> PathBuf {
    store.join("keys").join(format!("{role}.key"))
}

fn read_or_make(path: &Path) -> Result<SigningKey, StoreError> {
    match signed::read_hex_key(path) {
        Ok(secret) => return Ok(SigningKey::from_bytes(&secret.0)),
        Err(StoreError::Io(e)) if e.kind() == io::ErrorKind::NotFound => {}
        Err(e) => return Err(e),
    }
    let key = manifest::generate_key();
    let part = path.with_extension("part");
    if part.exists() {
        fs_err::remove_file(&part)?;
    }
    let text = format!("{}\n", hex::encode(key.to_bytes()));
    files::replace(&part, path, text.as_bytes(), Access::Private)?;
    Ok(key)
}
