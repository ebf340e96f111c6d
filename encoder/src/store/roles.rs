//! The signing keys of the metadata roles, and the folders in which they lie.
//!
//! | file | what |
//! |---|---|
//! | `keys/root/N.key` | root's keys; nothing but a change of keys needs them, so they may be kept elsewhere |
//! | `keys/targets.key`, `keys/snapshot.key`, `keys/timestamp.key` | keys that sign what is published |
//! | `keys/ROLE.next.key` | the same, from when it is made until a root that names it is installed |
//!
//! All are 64 hex digits, mode 0600.

use std::collections::BTreeMap;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use ed25519_dalek::SigningKey;
use slag_common::Hash32;
use slag_common::tuf::{Body, Key, RoleKeys, Root, generate_key};

use super::StoreError;
use super::files::{self, Access};

/// Roles whose keys lie with the store.
pub(super) const ONLINE: [&str; 3] = ["targets", "snapshot", "timestamp"];

pub(crate) fn root_folder(store: &Path) -> PathBuf {
    store.join("keys").join("root")
}

pub(super) fn read(store: &Path, role: &str) -> Result<SigningKey, StoreError> {
    let path = key_path(store, role);
    let what = match KeyFile::read(&path)? {
        KeyFile::Key(key) => return Ok(*key),
        KeyFile::Missing => "it is missing",
        KeyFile::Damaged => DAMAGED,
    };
    let help = format!(
        "restore it from a backup, or run `slag-encoder keys rotate {role}`, which makes a new key that robots follow by themselves"
    );
    Err(StoreError::Key { path, what, help })
}

/// Makes missing keys of all roles, and returns the body of a root with them and root's keys, `n_root_keys` in
/// `root_folder`.
pub(super) fn make_all(
    store: &Path,
    root_folder: &Path,
    n_root_keys: usize,
    threshold: u32,
) -> Result<(Root, Vec<SigningKey>), StoreError> {
    files::ensure_folder(&store.join("keys"))?;
    fs_err::create_dir_all(root_folder)?;
    let mut root_keys = read_folder(root_folder, Err).map_err(before_root)?;
    while root_keys.len() < n_root_keys {
        root_keys.push(make_root_key(root_folder)?);
    }
    root_keys.truncate(n_root_keys);
    let mut roles = BTreeMap::new();
    let mut keys = BTreeMap::new();
    let mut add = |role: &str, signers: &[SigningKey], threshold: u32| {
        let public: Vec<Key> = signers.iter().map(Key::of).collect();
        roles.insert(role.to_owned(), RoleKeys { keyids: public.iter().map(Key::id).collect(), threshold });
        keys.extend(public.into_iter().map(|key| (key.id(), key)));
    };
    add(Root::TYPE, &root_keys, threshold);
    for role in ONLINE {
        add(role, &[read_or_make(&key_path(store, role)).map_err(before_root)?], 1);
    }
    Ok((Root { consistent_snapshot: true, keys, roles }, root_keys))
}

/// Checks existing keys before the first root.
pub(super) fn check_before_root(store: &Path) -> Result<(), StoreError> {
    read_folder(&root_folder(store), Err).map_err(before_root)?;
    let is_damaged = |role: &&str| matches!(KeyFile::read(&key_path(store, role)), Ok(KeyFile::Damaged));
    match ONLINE.into_iter().find(is_damaged) {
        Some(role) => Err(before_root(damaged(key_path(store, role)))),
        None => Ok(()),
    }
}

/// Keys that no root names yet may be made anew.
fn before_root(error: StoreError) -> StoreError {
    match error {
        StoreError::Key { path, what, .. } => {
            let help = "no root names it yet: move it away, and a new key is made".into();
            StoreError::Key { path, what, help }
        }
        error => error,
    }
}

/// All root keys in a folder, by name; none without the folder.
pub(super) fn read_folder(
    folder: &Path,
    on_damage: impl Fn(StoreError) -> Result<(), StoreError>,
) -> Result<Vec<SigningKey>, StoreError> {
    let Some(entries) = files::if_there(fs_err::read_dir(folder))? else { return Ok(Vec::new()) };
    let mut paths = entries.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<PathBuf>>>()?;
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "key"));
    paths.sort();
    let mut keys = Vec::new();
    for path in paths {
        match KeyFile::read(&path)? {
            KeyFile::Key(key) => keys.push(*key),
            KeyFile::Missing => {}
            KeyFile::Damaged => on_damage(damaged(path))?,
        }
    }
    Ok(keys)
}

pub(super) fn make_root_key(folder: &Path) -> Result<SigningKey, StoreError> {
    let path = (1u32..).map(|number| folder.join(format!("{number}.key"))).find(|path| !path.exists());
    read_or_make(&path.unwrap_or_else(|| folder.join("0.key")))
}

/// Makes a role's next key, unless there is one that can sign.
pub(super) fn make_next(store: &Path, role: &str) -> Result<SigningKey, StoreError> {
    let path = key_path(store, &format!("{role}.next"));
    if matches!(KeyFile::read(&path)?, KeyFile::Damaged) {
        fs_err::remove_file(&path)?;
    }
    read_or_make(&path)
}

/// Replaces a role's key by its next one, if a root names that.
pub(super) fn promote(store: &Path, role: &str, root: &Root) -> Result<(), StoreError> {
    let next_path = key_path(store, &format!("{role}.next"));
    let KeyFile::Key(next) = KeyFile::read(&next_path)? else { return Ok(()) };
    if root.roles[role].keyids.contains(&Key::of(&next).id()) {
        files::move_into_place(&next_path, &key_path(store, role))?;
    }
    Ok(())
}

fn key_path(store: &Path, role: &str) -> PathBuf {
    store.join("keys").join(format!("{role}.key"))
}

fn read_or_make(path: &Path) -> Result<SigningKey, StoreError> {
    match KeyFile::read(path)? {
        KeyFile::Key(key) => return Ok(*key),
        KeyFile::Missing => {}
        KeyFile::Damaged => return Err(damaged(path.to_owned())),
    }
    let key = generate_key();
    let part = path.with_extension("part");
    if part.exists() {
        fs_err::remove_file(&part)?;
    }
    let text = format!("{}\n", hex::encode(key.to_bytes()));
    files::replace(&part, path, text.as_bytes(), Access::Private)?;
    Ok(key)
}

const DAMAGED: &str = "it is damaged: expected 64 hex digits";

fn damaged(path: PathBuf) -> StoreError {
    let help = "restore it from a backup, or move it away if root's other keys are enough (`slag-encoder keys status` tells the threshold)";
    StoreError::Key { path, what: DAMAGED, help: help.into() }
}

enum KeyFile {
    Key(Box<SigningKey>),
    Missing,
    Damaged,
}

impl KeyFile {
    fn read(path: &Path) -> Result<Self, StoreError> {
        let Some(file) = files::if_there(fs_err::File::open(path))? else { return Ok(Self::Missing) };
        let mut text = String::new();
        match file.take(256).read_to_string(&mut text) {
            Err(e) if e.kind() == io::ErrorKind::InvalidData => return Ok(Self::Damaged),
            read => read?,
        };
        let secret: Option<Hash32> = text.trim_end().parse().ok();
        Ok(secret.map_or(Self::Damaged, |secret| Self::Key(Box::new(SigningKey::from_bytes(&secret.0)))))
    }
}
