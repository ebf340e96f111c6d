//! The client workflow (section 5 of the specification): which files are read, in which order, and how much of each.

use super::error::TufError;
use super::kept::{Kept, text};
use super::metadata::{Body, DelegatedRole, Delegations, Root, Snapshot, TargetFile, Targets, Timestamp};
use super::trusted::Trusted;
use super::{
    MAX_DELEGATIONS, MAX_ROOT_BYTES, MAX_ROOTS, MAX_SNAPSHOT_BYTES, MAX_TARGETS_BYTES, MAX_TIMESTAMP_BYTES,
};

/// Where metadata comes from.
pub trait Source {
    /// Reads a metadata file, such as `2.root.json`: at most `max_bytes + 1` bytes, so that a longer one shows. `None` if
    /// there is no such file.
    ///
    /// # Errors
    /// One clause with the cause, if the file can be neither read nor said to be missing.
    fn metadata(&mut self, name: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, String>;
}

/// Brings what is kept up to date and returns it, checked: roots, timestamp, snapshot and top-level targets.
///
/// `kept` holds what was accepted, also after an error, so that a root that names new keys counts even if the rest does
/// not arrive. The caller makes it durable in both cases. `clock_unix_secs`: the time; a later signed time counts instead.
///
/// # Errors
/// [`TufError`].
pub fn refresh(kept: &mut Kept, source: &mut dyn Source, clock_unix_secs: u64) -> Result<Trusted, TufError> {
    let mut trusted = Trusted::new(kept.root.as_bytes(), clock_unix_secs)?;
    add_roots(&mut trusted, kept, source)?;
    add_timestamp(&mut trusted, kept, source)?;
    add_snapshot(&mut trusted, kept, source)?;
    add_targets(&mut trusted, kept, source, None)?;
    Ok(trusted)
}

/// Finds a file in the targets metadata, top-level role first, then delegated roles in order of priority. `None` if no
/// role that may sign for the path lists it.
///
/// # Errors
/// [`TufError`].
pub fn find_target(
    trusted: &mut Trusted,
    kept: &mut Kept,
    source: &mut dyn Source,
    path: &str,
) -> Result<Option<TargetFile>, TufError> {
    // Roles still to be asked, the next one last.
    let mut open: Vec<Option<(Delegations, DelegatedRole)>> = vec![None];
    let mut asked = std::collections::BTreeSet::new();
    while let Some(from) = open.pop() {
        let role = from.as_ref().map_or(Targets::TYPE.to_owned(), |(_, delegated)| delegated.name.clone());
        if !asked.insert(role.clone()) {
            continue;
        }
        if asked.len() > MAX_DELEGATIONS {
            return Err(TufError::TooMany { what: "delegated roles", limit: MAX_DELEGATIONS });
        }
        if from.is_some() || trusted.targets(&role).is_none() {
            let from = from.as_ref().map(|(delegations, delegated)| (delegations, delegated));
            add_targets(trusted, kept, source, from)?;
        }
        let Some(targets) = trusted.targets(&role) else { continue };
        if let Some(found) = targets.body.targets.get(path) {
            return Ok(Some(found.clone()));
        }
        let Some(delegations) = &targets.body.delegations else { continue };
        let mut next = Vec::new();
        for delegated in delegations.roles.iter().filter(|delegated| delegated.signs_for(path)) {
            next.push(Some((delegations.clone(), delegated.clone())));
            if delegated.terminating {
                // Nothing that was put off is asked after it.
                open.clear();
                break;
            }
        }
        open.extend(next.into_iter().rev());
    }
    Ok(None)
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
        // Recovery from a fast-forward attack (5.3.11): new keys begin to count anew.
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
    // Roles that are gone are not kept for ever.
    kept.targets.retain(|role, _| trusted.targets_meta(role).is_ok());
    Ok(())
}

fn add_targets(
    trusted: &mut Trusted,
    kept: &mut Kept,
    source: &mut dyn Source,
    from: Option<(&Delegations, &DelegatedRole)>,
) -> Result<(), TufError> {
    let role = from.map_or(Targets::TYPE, |(_, delegated)| &delegated.name);
    if let Some(before) = kept.targets.get(role)
        && trusted.add_targets(before.as_bytes(), from).is_ok()
    {
        return Ok(());
    }
    let meta = trusted.targets_meta(role)?.clone();
    let name = format!("{}.{}.json", meta.version, file_name(role));
    let bytes = read_all(source, &name, meta.length.unwrap_or(MAX_TARGETS_BYTES).min(MAX_TARGETS_BYTES))?;
    trusted.add_targets(&bytes, from)?;
    kept.targets.insert(role.to_owned(), text(role, &bytes)?);
    Ok(())
}

/// Returns a role's name as part of a file name: all but letters, digits, `_`, `.`, `-` and `~` in percent encoding.
fn file_name(role: &str) -> String {
    let encoded = |byte: u8| match byte {
        b'0'..=b'9' | b'a'..=b'z' | b'A'..=b'Z' | b'_' | b'.' | b'-' | b'~' => char::from(byte).to_string(),
        _ => format!("%{byte:02X}"),
    };
    role.bytes().map(encoded).collect()
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
