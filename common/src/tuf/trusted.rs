//! The rules of each step: what a new file must satisfy, given what is already trusted. Steps follow the
//! specification: roots, timestamp, snapshot, targets. A step that fails changes nothing.

use serde::{Deserialize, Serialize};

use super::error::TufError;
use super::metadata::{Body, FileMeta, RoleKeys, Root, Snapshot, TargetFile, Targets, Timestamp};
use super::signed::SignedMetadata;
use super::time::parse_utc;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Offered {
    /// Replaces the previous file.
    New,
    /// Has the version of the previous file, which is kept.
    Same,
}

#[derive(Clone, Debug)]
pub struct Trusted {
    root: SignedMetadata<Root>,
    timestamp: Option<SignedMetadata<Timestamp>>,
    snapshot: Option<SignedMetadata<Snapshot>>,
    targets: Option<SignedMetadata<Targets>>,
    now_unix_secs: u64,
}

impl Trusted {
    /// Begins with a trusted root. `now_unix_secs`: the clock.
    pub fn new(root: &[u8], now_unix_secs: u64) -> Result<Self, TufError> {
        let root = parse_own_root(root)?;
        Ok(Self { root, timestamp: None, snapshot: None, targets: None, now_unix_secs })
    }

    pub fn root(&self) -> &SignedMetadata<Root> {
        &self.root
    }

    pub fn timestamp(&self) -> Option<&SignedMetadata<Timestamp>> {
        self.timestamp.as_ref()
    }

    pub fn snapshot(&self) -> Option<&SignedMetadata<Snapshot>> {
        self.snapshot.as_ref()
    }

    pub fn targets(&self) -> Option<&SignedMetadata<Targets>> {
        self.targets.as_ref()
    }

    pub fn target(&self, path: &str) -> Option<&TargetFile> {
        self.targets.as_ref()?.body.targets.get(path)
    }

    /// Returns the reference time: the later of the clock and the newest signed time, seconds since 1970.
    pub fn now_unix_secs(&self) -> u64 {
        self.now_unix_secs
    }

    /// Accepts the next root (5.3.4, 5.3.5): version plus one, signed by the present root's keys and by its own.
    pub fn add_root(&mut self, bytes: &[u8]) -> Result<(), TufError> {
        self.before_timestamp(Root::TYPE)?;
        let next = SignedMetadata::<Root>::parse(Root::TYPE, bytes)?;
        self.check_signatures(Root::TYPE, &next)?;
        let expected = self.root.head.version.saturating_add(1);
        if next.head.version != expected {
            let (role, found) = (Root::TYPE.to_owned(), next.head.version);
            return Err(TufError::Version { role, expected, found });
        }
        self.root = parse_own_root(bytes)?;
        Ok(())
    }

    /// Accepts the timestamp of an earlier update, whatever its expiry.
    ///
    /// # Errors
    /// [`TufError`], if the present root does not vouch for it; it then counts as absent.
    pub fn recall_timestamp(&mut self, bytes: &[u8]) -> Result<(), TufError> {
        self.before_timestamp(Timestamp::TYPE)?;
        let kept = SignedMetadata::<Timestamp>::parse(Timestamp::TYPE, bytes)?;
        self.check_signatures(Timestamp::TYPE, &kept)?;
        self.now_unix_secs = self.now_unix_secs.max(signed_unix_secs(&kept).unwrap_or(0));
        self.timestamp = Some(kept);
        Ok(())
    }

    /// Accepts a timestamp (5.4): signed, not older than the previous one, not expired.
    pub fn add_timestamp(&mut self, bytes: &[u8]) -> Result<Offered, TufError> {
        if self.snapshot.is_some() {
            return Err(TufError::Order { role: Timestamp::TYPE.into() });
        }
        self.root.check_expiry(Root::TYPE, self.now_unix_secs)?;
        let new = SignedMetadata::<Timestamp>::parse(Timestamp::TYPE, bytes)?;
        self.check_signatures(Timestamp::TYPE, &new)?;
        if let Some(before) = &self.timestamp {
            check_not_older(Timestamp::TYPE, before.head.version, new.head.version)?;
            if before.head.version == new.head.version {
                before.check_expiry(Timestamp::TYPE, self.now_unix_secs)?;
                return Ok(Offered::Same);
            }
            let (seen, offered) = (before.body.snapshot().version, new.body.snapshot().version);
            check_not_older(Snapshot::TYPE, seen, offered)?;
        }
        new.check_expiry(Timestamp::TYPE, self.now_unix_secs)?;
        // The newest signed time may be later than the clock at which the root was valid.
        let now_unix_secs = self.now_unix_secs.max(signed_unix_secs(&new).unwrap_or(0));
        self.root.check_expiry(Root::TYPE, now_unix_secs)?;
        (self.now_unix_secs, self.timestamp) = (now_unix_secs, Some(new));
        Ok(Offered::New)
    }

    /// Accepts a snapshot (5.5): the one in the timestamp, signed, not expired. `before`: the snapshot of an earlier
    /// update; all its targets metadata must still be listed, none with a lower version.
    pub fn add_snapshot(&mut self, bytes: &[u8], before: Option<&[u8]>) -> Result<(), TufError> {
        let order = || TufError::Order { role: Snapshot::TYPE.into() };
        let meta = self.timestamp.as_ref().filter(|_| self.targets.is_none()).ok_or_else(order)?;
        let meta = meta.body.snapshot();
        meta.check(Snapshot::TYPE, bytes)?;
        let new = SignedMetadata::<Snapshot>::parse(Snapshot::TYPE, bytes)?;
        self.check_signatures(Snapshot::TYPE, &new)?;
        check_version(Snapshot::TYPE, meta, new.head.version)?;
        let before = before.and_then(|bytes| SignedMetadata::<Snapshot>::parse(Snapshot::TYPE, bytes).ok());
        // Ignore a snapshot that the present root does not vouch for (recovery from a fast-forward attack).
        let before = before.filter(|before| self.check_signatures(Snapshot::TYPE, before).is_ok());
        for (name, seen) in before.iter().flat_map(|before| &before.body.meta) {
            match new.body.meta.get(name) {
                Some(offered) => check_not_older(name, seen.version, offered.version)?,
                None => return Err(TufError::Missing { what: name.clone() }),
            }
        }
        new.check_expiry(Snapshot::TYPE, self.now_unix_secs)?;
        self.snapshot = Some(new);
        Ok(())
    }

    /// Accepts targets metadata (5.6): the one in the snapshot, signed, not expired.
    pub fn add_targets(&mut self, bytes: &[u8]) -> Result<(), TufError> {
        let meta = self.targets_meta()?;
        meta.check(Targets::TYPE, bytes)?;
        let new = SignedMetadata::<Targets>::parse(Targets::TYPE, bytes)?;
        self.check_signatures(Targets::TYPE, &new)?;
        check_version(Targets::TYPE, meta, new.head.version)?;
        new.check_expiry(Targets::TYPE, self.now_unix_secs)?;
        self.targets = Some(new);
        Ok(())
    }

    pub(super) fn targets_meta(&self) -> Result<&FileMeta, TufError> {
        let order = || TufError::Order { role: Targets::TYPE.into() };
        Ok(&self.snapshot.as_ref().ok_or_else(order)?.body.meta["targets.json"])
    }

    fn check_signatures<T: Body>(&self, role: &str, metadata: &SignedMetadata<T>) -> Result<(), TufError> {
        metadata.check_signatures(role, &self.root.body.keys, self.keys_of(role))
    }

    fn keys_of(&self, role: &str) -> &RoleKeys {
        &self.root.body.roles[role]
    }

    fn before_timestamp(&self, role: &str) -> Result<(), TufError> {
        match self.timestamp {
            Some(_) => Err(TufError::Order { role: role.to_owned() }),
            None => Ok(()),
        }
    }
}

fn check_not_older(role: &str, seen: u64, offered: u64) -> Result<(), TufError> {
    match offered < seen {
        true => Err(TufError::Rollback { role: role.to_owned(), seen, offered }),
        false => Ok(()),
    }
}

fn check_version(role: &str, stated: &FileMeta, found: u64) -> Result<(), TufError> {
    match stated.version == found {
        true => Ok(()),
        false => Err(TufError::Version { role: role.to_owned(), expected: stated.version, found }),
    }
}

/// Accepted metadata, byte for byte. Checked again at each use, against the newest root.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Kept {
    pub root: String,
    pub timestamp: Option<String>,
    pub snapshot: Option<String>,
    /// Saves a download; need not outlive the process, because the snapshot states its version.
    #[serde(skip)]
    pub targets: Option<String>,
}

impl Kept {
    /// Begins with a root trusted by hand.
    pub fn from_root(bytes: &[u8]) -> Result<Self, TufError> {
        parse_own_root(bytes)?;
        Ok(Self { root: text(Root::TYPE, bytes)?, timestamp: None, snapshot: None, targets: None })
    }

    pub fn root_version(&self) -> Option<u64> {
        SignedMetadata::<Root>::parse(Root::TYPE, self.root.as_bytes()).ok().map(|root| root.head.version)
    }

    /// Expiry of the newest timestamp, seconds since 1970.
    pub fn expires_unix_secs(&self) -> Option<u64> {
        let bytes = self.timestamp.as_ref()?.as_bytes();
        Some(SignedMetadata::<Timestamp>::parse(Timestamp::TYPE, bytes).ok()?.expires_unix_secs)
    }

    /// Time of signing in the newest timestamp, seconds since 1970; before its expiry.
    pub fn signed_unix_secs(&self) -> Option<u64> {
        let bytes = self.timestamp.as_ref()?.as_bytes();
        signed_unix_secs(&SignedMetadata::parse(Timestamp::TYPE, bytes).ok()?)
    }
}

pub(super) fn signed_unix_secs(timestamp: &SignedMetadata<Timestamp>) -> Option<u64> {
    let signed = timestamp.body.signed_at.as_deref().and_then(parse_utc)?;
    (signed < timestamp.expires_unix_secs).then_some(signed)
}

/// Parses a root signed by its own keys.
pub(super) fn parse_own_root(bytes: &[u8]) -> Result<SignedMetadata<Root>, TufError> {
    let root = SignedMetadata::<Root>::parse(Root::TYPE, bytes)?;
    root.check_signatures(Root::TYPE, &root.body.keys, &root.body.roles[Root::TYPE])?;
    Ok(root)
}

/// Metadata as text: parsed JSON is UTF-8.
pub(super) fn text(role: &str, bytes: &[u8]) -> Result<String, TufError> {
    String::from_utf8(bytes.to_vec())
        .map_err(|e| TufError::Format { role: role.to_owned(), what: e.to_string() })
}
