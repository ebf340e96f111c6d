//! The signed content of the roles. Unknown members are ignored, as the specification demands.

use std::collections::BTreeMap;

use ed25519_dalek::{SigningKey, VerifyingKey};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sha2::{Digest, Sha256, Sha512};

use super::canonical::canonical_json;
use super::error::TufError;

/// The signed content of a role, without the head.
pub trait Body: Serialize + DeserializeOwned {
    /// `_type` of the metadata.
    const TYPE: &'static str;

    /// Checks what the types do not; returns the fault.
    fn check(&self) -> Result<(), String> {
        Ok(())
    }
}

/// The keys of a role, and how many must sign.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RoleKeys {
    pub keyids: Vec<String>,
    /// Least number of signatures by different keys.
    pub threshold: u32,
}

impl RoleKeys {
    fn check(&self, role: &str) -> Result<(), String> {
        if self.threshold == 0 {
            return Err(format!("role {role} needs no signature"));
        }
        let mut ids: Vec<&String> = self.keyids.iter().collect();
        ids.sort_unstable();
        match ids.windows(2).find(|pair| pair[0] == pair[1]) {
            Some(pair) => Err(format!("role {role} lists key {} twice", pair[0])),
            None => Ok(()),
        }
    }
}

/// Root: the keys of all roles.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Root {
    /// Whether file names begin with version or hash; only such repositories are read.
    pub consistent_snapshot: bool,
    pub keys: BTreeMap<String, Key>,
    /// `root`, `targets`, `snapshot` and `timestamp`.
    pub roles: BTreeMap<String, RoleKeys>,
}

impl Body for Root {
    const TYPE: &'static str = "root";

    fn check(&self) -> Result<(), String> {
        if !self.consistent_snapshot {
            return Err(
                "consistent_snapshot is false; only repositories with consistent snapshots are read".into()
            );
        }
        for role in ["root", "targets", "snapshot", "timestamp"] {
            self.roles.get(role).ok_or_else(|| format!("role {role} is missing"))?.check(role)?;
        }
        Ok(())
    }
}

/// Version of a metadata file, and its length and hashes where they are stated.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileMeta {
    pub version: u64,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub length: Option<u64>,
    /// Hashes by algorithm, hex.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub hashes: Option<BTreeMap<String, String>>,
}

impl FileMeta {
    pub fn of(version: u64, bytes: &[u8]) -> Self {
        Self { version, length: Some(bytes.len() as u64), hashes: Some(hashes_of(bytes)) }
    }

    pub(super) fn check(&self, role: &str, bytes: &[u8]) -> Result<(), TufError> {
        check_content(role, bytes, self.length, self.hashes.as_ref())
    }
}

/// Timestamp: which snapshot is the newest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Timestamp {
    /// `snapshot.json` only.
    pub meta: BTreeMap<String, FileMeta>,
    /// Time of signing; a member of our own, which other clients ignore.
    #[serde(rename = "x-slag-signed-at", skip_serializing_if = "Option::is_none", default)]
    pub signed_at: Option<String>,
}

impl Timestamp {
    pub fn snapshot(&self) -> &FileMeta {
        &self.meta["snapshot.json"]
    }
}

impl Body for Timestamp {
    const TYPE: &'static str = "timestamp";

    fn check(&self) -> Result<(), String> {
        match self.meta.contains_key("snapshot.json") && self.meta.len() == 1 {
            true => Ok(()),
            false => Err("meta does not list snapshot.json alone".into()),
        }
    }
}

/// Snapshot: the versions of all targets metadata.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// By file name without version, such as `targets.json`.
    pub meta: BTreeMap<String, FileMeta>,
}

impl Body for Snapshot {
    const TYPE: &'static str = "snapshot";

    fn check(&self) -> Result<(), String> {
        match self.meta.contains_key("targets.json") {
            true => Ok(()),
            false => Err("meta does not list targets.json".into()),
        }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TargetFile {
    pub length: u64,
    /// Hashes by algorithm, hex.
    pub hashes: BTreeMap<String, String>,
    /// Anything that the publisher states about it.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub custom: Option<Value>,
}

impl TargetFile {
    pub fn of(bytes: &[u8]) -> Self {
        Self { length: bytes.len() as u64, hashes: hashes_of(bytes), custom: None }
    }

    /// Returns the name of the file at a path in a repository with consistent snapshots.
    pub fn file_name(&self, path: &str) -> Result<String, TufError> {
        let hash = ["sha256", "sha512"].into_iter().find_map(|algorithm| self.hashes.get(algorithm));
        // Only hex digits may become part of a name.
        let hash =
            hash.filter(|hash| hash.bytes().all(|byte| byte.is_ascii_hexdigit())).ok_or_else(|| {
                let fault = "no hash of a known kind is stated, expected sha256 or sha512".into();
                TufError::Content { what: path.to_owned(), fault }
            })?;
        Ok(match path.rsplit_once('/') {
            Some((folder, name)) => format!("{folder}/{hash}.{name}"),
            None => format!("{hash}.{path}"),
        })
    }

    pub fn check(&self, path: &str, bytes: &[u8]) -> Result<(), TufError> {
        check_content(path, bytes, Some(self.length), Some(&self.hashes))
    }
}

/// Targets: the files. Delegations are not followed.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Targets {
    pub targets: BTreeMap<String, TargetFile>,
}

impl Body for Targets {
    const TYPE: &'static str = "targets";
}

pub fn sha256_hex(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

fn hashes_of(bytes: &[u8]) -> BTreeMap<String, String> {
    BTreeMap::from([("sha256".to_owned(), sha256_hex(bytes))])
}

fn check_content(
    what: &str,
    bytes: &[u8],
    length: Option<u64>,
    hashes: Option<&BTreeMap<String, String>>,
) -> Result<(), TufError> {
    let refuse = |fault: String| Err(TufError::Content { what: what.to_owned(), fault });
    let found_bytes = bytes.len() as u64;
    if let Some(expected) = length.filter(|expected| *expected != found_bytes) {
        return refuse(format!("it has {found_bytes} bytes, expected {expected}"));
    }
    let Some(hashes) = hashes else { return Ok(()) };
    let mut n_known = 0;
    for (algorithm, expected) in hashes {
        let found = match algorithm.as_str() {
            "sha256" => sha256_hex(bytes),
            "sha512" => hex::encode(Sha512::digest(bytes)),
            _ => continue,
        };
        n_known += 1;
        if found != *expected {
            return refuse(format!("its {algorithm} is {found}, expected {expected}"));
        }
    }
    match n_known {
        0 => refuse("no hash of a known kind is stated, expected sha256 or sha512".into()),
        _ => Ok(()),
    }
}

const ED25519: &str = "ed25519";

/// A public key in metadata. Only Ed25519 keys verify; others are kept and never count.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Key {
    pub keytype: String,
    pub scheme: String,
    /// The key's values; `public` is the public key in hex.
    pub keyval: BTreeMap<String, Value>,
}

impl Key {
    pub fn of(key: &SigningKey) -> Self {
        let public = hex::encode(key.verifying_key().to_bytes());
        let keyval = BTreeMap::from([("public".to_owned(), Value::String(public))]);
        Self { keytype: ED25519.into(), scheme: ED25519.into(), keyval }
    }

    /// Returns the key id: the SHA-256 of its canonical form, in hex.
    pub fn id(&self) -> String {
        let value = json!({ "keytype": self.keytype, "scheme": self.scheme, "keyval": self.keyval });
        // A value that is not text makes the key useless, not the id wrong: such a key never verifies.
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
