//! The client workflow (section 5 of the specification): the files read, their order, and their largest lengths.

use super::error::TufError;
use super::metadata::{Body, Root, Snapshot, Targets, Timestamp};
use super::trusted::{Kept, Trusted, text};
use super::{MAX_ROOT_BYTES, MAX_ROOTS, MAX_SNAPSHOT_BYTES, MAX_TARGETS_BYTES, MAX_TIMESTAMP_BYTES};

pub trait Source {
    /// Reads a file such as `2.root.json`, if it exists: up to `max_bytes + 1` bytes, so that a longer one is noticed.
    fn metadata(&mut self, name: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, String>;
}

/// Updates `kept` and returns it, checked: roots, timestamp, snapshot and top-level targets.
///
/// `kept` has what was accepted even after an error, so that a root with new keys counts although the rest does not
/// arrive; the caller makes it durable in both cases. A signed time later than `clock_unix_secs` counts instead.
pub fn refresh(kept: &mut Kept, source: &mut dyn Source, clock_unix_secs: u64) -> Result<Trusted, TufError> {
    let mut trusted = Trusted::new(kept.root.as_bytes(), clock_unix_secs)?;
    add_roots(&mut trusted, kept, source)?;
    add_timestamp(&mut trusted, kept, source)?;
    add_snapshot(&mut trusted, kept, source)?;
    add_targets(&mut trusted, kept, source)?;
    Ok(trusted)
}

fn add_roots(trusted: &mut Trusted, kept: &mut Kept, source: &mut dyn Source) -> Result<(), TufError> {
    let first = trusted.root().body.clone();
    let mut n_new = 0;
    loop {
        let name = format!("{}.root.json", trusted.root().head.version.saturating_add(1));
        let Some(bytes) = read(source, &name, MAX_ROOT_BYTES)? else { break };
        if n_new == MAX_ROOTS {
            return Err(TufError::TooMany { what: "new roots", limit: MAX_ROOTS as usize });
        }
        trusted.add_root(&bytes)?;
        kept.root = text(Root::TYPE, &bytes)?;
        n_new += 1;
        // Recovery from a fast-forward attack (5.3.11): with new keys, versions start anew.
        let last = &trusted.root().body;
        let changed = |role: &str| {
            first.roles[role] != last.roles[role]
                || last.roles[role].keyids.iter().any(|id| first.keys.get(id) != last.keys.get(id))
        };
        if changed(Timestamp::TYPE) || changed(Snapshot::TYPE) {
            (kept.timestamp, kept.snapshot) = (None, None);
        }
    }
    trusted.root().check_expiry(Root::TYPE, trusted.now_unix_secs())
}

fn add_timestamp(trusted: &mut Trusted, kept: &mut Kept, source: &mut dyn Source) -> Result<(), TufError> {
    if let Some(before) = &kept.timestamp
        && trusted.recall_timestamp(before.as_bytes()).is_err()
    {
        kept.timestamp = None;
    }
    let bytes = read_all(source, "timestamp.json", MAX_TIMESTAMP_BYTES)?;
    if trusted.add_timestamp(&bytes)? == super::Offered::New {
        kept.timestamp = Some(text(Timestamp::TYPE, &bytes)?);
    }
    Ok(())
}

fn add_snapshot(trusted: &mut Trusted, kept: &mut Kept, source: &mut dyn Source) -> Result<(), TufError> {
    let Some(timestamp) = trusted.timestamp() else {
        return Err(TufError::Order { role: Snapshot::TYPE.into() });
    };
    let meta = timestamp.body.snapshot().clone();
    let before = kept.snapshot.as_ref().map(String::as_bytes);
    if before.is_some_and(|before| trusted.add_snapshot(before, None).is_ok()) {
        return Ok(());
    }
    let name = format!("{}.snapshot.json", meta.version);
    let bytes = read_all(source, &name, meta.length.unwrap_or(MAX_SNAPSHOT_BYTES).min(MAX_SNAPSHOT_BYTES))?;
    trusted.add_snapshot(&bytes, before)?;
    kept.snapshot = Some(text(Snapshot::TYPE, &bytes)?);
    Ok(())
}

fn add_targets(trusted: &mut Trusted, kept: &mut Kept, source: &mut dyn Source) -> Result<(), TufError> {
    if kept.targets.as_ref().is_some_and(|before| trusted.add_targets(before.as_bytes()).is_ok()) {
        return Ok(());
    }
    let meta = trusted.targets_meta()?.clone();
    let name = format!("{}.targets.json", meta.version);
    let bytes = read_all(source, &name, meta.length.unwrap_or(MAX_TARGETS_BYTES).min(MAX_TARGETS_BYTES))?;
    trusted.add_targets(&bytes)?;
    kept.targets = Some(text(Targets::TYPE, &bytes)?);
    Ok(())
}

fn read(source: &mut dyn Source, name: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, TufError> {
    let read = source.metadata(name, max_bytes);
    let bytes = read.map_err(|fault| TufError::Source { what: name.to_owned(), fault })?;
    match bytes {
        Some(bytes) if bytes.len() as u64 > max_bytes => {
            Err(TufError::TooLong { what: name.to_owned(), max_bytes })
        }
        bytes => Ok(bytes),
    }
}

fn read_all(source: &mut dyn Source, name: &str, max_bytes: u64) -> Result<Vec<u8>, TufError> {
    read(source, name, max_bytes)?.ok_or_else(|| TufError::Missing { what: name.to_owned() })
}
