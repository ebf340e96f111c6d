//! Changes of the keys that a store's root names.
//!
//! The next root takes effect once enough keys of the present root and of its own have signed it. If root's keys are
//! kept elsewhere, it waits as a draft, `keys/N.root.draft.json`, which is carried there, signed, carried back and
//! installed.

use std::path::{Path, PathBuf};

use ed25519_dalek::SigningKey;
use serde::Serialize;
use slag_common::tuf::{
    Body, Key, Root, SignedMetadata, Trusted, TufError, add_signatures, sha256_hex, sign,
};

use super::metadata::{Metadata, MetadataReader, ROOT_SECS};
use super::{StoreError, files, roles};

pub(crate) use super::roles::root_folder as default_root_folder;

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Change {
    /// All keys of these roles; without roles, the root is signed anew for its whole time.
    Roles(Vec<String>),
    /// This key id, in all roles.
    Key(String),
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Changed {
    pub(crate) root_version: u64,
    /// SHA-256 of the root, hex; absent while it is a draft.
    pub root_sha256: Option<String>,
    pub(crate) draft: Option<PathBuf>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct KeyStatus {
    pub(crate) role: String,
    pub(crate) id: String,
    /// Whether its secret half lies here.
    pub(crate) is_here: bool,
}

/// The keys of a store, and until when they count.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct KeysStatus {
    pub(crate) root_version: u64,
    pub root_sha256: String,
    pub(crate) root_expires_unix_secs: u64,
    pub(crate) threshold: u32,
    pub(crate) keys: Vec<KeyStatus>,
    /// When the timestamp expires, seconds since 1970; absent before the first publication.
    pub(crate) timestamp_expires_unix_secs: Option<u64>,
}

impl Metadata {
    /// Makes new keys, and a root that names them: installed at once if root's keys in `root_folder` are enough,
    /// otherwise a draft.
    pub(crate) fn change_keys(
        &self,
        change: &Change,
        root_folder: &Path,
        now_unix_secs: u64,
    ) -> Result<Changed, StoreError> {
        let present = self.newest_root()?.ok_or_else(|| self.no_root())?.0;
        let body = self.next_root(&present.body, change, root_folder)?;
        let is_of_root = |key: &SigningKey| {
            let id = Key::of(key).id();
            [&present.body, &body].iter().any(|root| root.roles[Root::TYPE].keyids.contains(&id))
        };
        let signers: Vec<SigningKey> =
            roles::read_folder(root_folder, Err)?.into_iter().filter(is_of_root).collect();
        let root_version = present.head.version.saturating_add(1);
        let expires = now_unix_secs.saturating_add(ROOT_SECS);
        let bytes = sign(root_version, expires, &body, &signers.iter().collect::<Vec<_>>());
        let draft = self.store.join("keys").join(format!("{root_version}.root.draft.json"));
        slag_common::durable::write(&draft, &bytes)?;
        match self.install_root(&draft, now_unix_secs) {
            Err(StoreError::RootDraft { cause: TufError::Signatures { .. }, .. }) => {
                Ok(Changed { root_version, root_sha256: None, draft: Some(draft) })
            }
            installed => installed,
        }
    }

    /// Installs a signed draft, and signs again what the former keys signed.
    ///
    /// # Errors
    /// [`StoreError::RootDraft`] unless it follows the present root; [`StoreError`] otherwise.
    pub(crate) fn install_root(&self, draft: &Path, now_unix_secs: u64) -> Result<Changed, StoreError> {
        let (present, bytes) = self.newest_root()?.ok_or_else(|| self.no_root())?;
        let next = fs_err::read(draft)?;
        let refuse = |cause| StoreError::RootDraft { path: draft.to_owned(), cause };
        let mut trusted = Trusted::new(&bytes, now_unix_secs).map_err(refuse)?;
        trusted.add_root(&next).map_err(refuse)?;
        let root = trusted.root();
        let root_version = root.head.version;
        self.write(&format!("{root_version}.root.json"), &next)?;
        for role in roles::ONLINE {
            roles::promote(&self.store, role, &root.body)?;
        }
        let is_changed = |role: &str| root.body.roles[role] != present.body.roles[role];
        // After an interrupted change, the former keys' signatures may still stand.
        if (roles::ONLINE.into_iter().any(is_changed) || self.is_refused()?)
            && let Some(targets) = self.targets(&present.body)?
        {
            self.sign_all(&targets, now_unix_secs)?;
        }
        let made_here = self.store.join("keys").join(format!("{root_version}.root.draft.json"));
        if made_here.exists() {
            fs_err::remove_file(&made_here)?;
            files::sync_folder(&self.store.join("keys"))?;
        }
        Ok(Changed { root_version, root_sha256: Some(sha256_hex(&next)), draft: None })
    }

    /// The present root with new keys in place of the replaced ones.
    fn next_root(&self, present: &Root, change: &Change, root_folder: &Path) -> Result<Root, StoreError> {
        let is_replaced = |role: &str, id: &str| match change {
            Change::Roles(roles) => roles.iter().any(|named| named == role),
            Change::Key(key) => key == id,
        };
        let mut next = present.clone();
        let mut n_replaced = 0;
        for (role, keys) in &mut next.roles {
            for id in &mut keys.keyids {
                if !is_replaced(role, id) {
                    continue;
                }
                let key = match role == Root::TYPE {
                    true => roles::make_root_key(root_folder)?,
                    false => roles::make_next(&self.store, role)?,
                };
                let public = Key::of(&key);
                *id = public.id();
                next.keys.insert(public.id(), public);
                n_replaced += 1;
            }
            keys.keyids.sort();
            keys.keyids.dedup();
        }
        if let (0, Change::Key(id)) = (n_replaced, change) {
            let help = "`slag-encoder keys status` lists the keys";
            return Err(StoreError::Failed(format!("no role has the key {id}; {help}")));
        }
        let used: Vec<&String> = next.roles.values().flat_map(|keys| &keys.keyids).collect();
        next.keys.retain(|id, _| used.contains(&id));
        Ok(next)
    }
}

impl MetadataReader {
    pub(crate) fn keys_status(&self, root_folder: &Path) -> Result<KeysStatus, StoreError> {
        let (root, bytes) = self.newest_root()?.ok_or_else(|| self.no_root())?;
        if self.is_refused()? {
            tracing::warn!(
                "robots refuse the store: its metadata is damaged, or not signed by the keys of root {}, as after an \
                 interrupted change of keys; run `slag-encoder store refresh --store {}`",
                root.head.version,
                self.store.display()
            );
        }
        let warn = |error: StoreError| {
            tracing::warn!("{error}");
            Ok(())
        };
        let sound = roles::read_folder(root_folder, warn)?;
        let mut here: Vec<String> = sound.iter().map(|key| Key::of(key).id()).collect();
        let online = roles::ONLINE.iter().filter_map(|role| roles::read(&self.store, role).ok());
        here.extend(online.map(|key| Key::of(&key).id()));
        let mut keys = Vec::new();
        for role in std::iter::once(Root::TYPE).chain(roles::ONLINE) {
            keys.extend(root.body.roles[role].keyids.iter().map(|id| KeyStatus {
                role: role.to_owned(),
                id: id.clone(),
                is_here: here.contains(id),
            }));
        }
        Ok(KeysStatus {
            root_version: root.head.version,
            root_sha256: sha256_hex(&bytes),
            root_expires_unix_secs: root.expires_unix_secs,
            threshold: root.body.roles[Root::TYPE].threshold,
            keys,
            timestamp_expires_unix_secs: self.timestamp()?.map(|timestamp| timestamp.expires_unix_secs),
        })
    }

    /// SHA-256 of the newest root, hex.
    pub(crate) fn root_sha256(&self) -> Result<String, StoreError> {
        Ok(sha256_hex(&self.newest_root()?.ok_or_else(|| self.no_root())?.1))
    }

    fn no_root(&self) -> StoreError {
        if self.is_published().unwrap_or(false) {
            return StoreError::RootLost { path: self.path("1.root.json") };
        }
        let store = self.store.display();
        StoreError::Failed(format!("{store} has no root yet; run `slag-encoder keys init`, or encode"))
    }
}

/// Signs a draft with all keys of a folder; returns their number.
pub(crate) fn sign_draft(draft: &Path, root_folder: &Path) -> Result<usize, StoreError> {
    let refuse = |cause| StoreError::RootDraft { path: draft.to_owned(), cause };
    let bytes = fs_err::read(draft)?;
    SignedMetadata::<Root>::parse(Root::TYPE, &bytes).map_err(refuse)?;
    let keys = roles::read_folder(root_folder, Err)?;
    let signed = add_signatures(Root::TYPE, &bytes, &keys).map_err(refuse)?;
    slag_common::durable::write(draft, &signed)?;
    Ok(keys.len())
}
