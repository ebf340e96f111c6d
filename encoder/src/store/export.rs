//! A store as static files, laid out as robots ask for them, for any web server.
//!
//! | path | content |
//! |---|---|
//! | `v1/objects/HASH` | shards, and text models, of the current generation and of the one before it |
//! | `v1/targets/SHA256.manifest`, `v1/manifest` | their manifests; the current one |
//! | `v1/metadata/` | metadata of The Update Framework; robots follow `timestamp.json`, which is written last |

use std::collections::BTreeMap;
use std::path::Path;

use rayon::prelude::*;
use serde::Serialize;
use slag_common::tuf::{TargetFile, TufError};
use slag_common::{Hash32, durable, manifest};

use super::metadata::clock_unix_secs;
use super::reader::{Published, StoreReader};
use super::verify::{self, Refused};
use super::{StoreError, files};

const FIRST_ROOT: &str = "1.root.json";

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct Exported {
    pub(crate) n_files: usize,
    pub(crate) len_bytes: u64,
    /// Objects removed that neither generation needs.
    pub(crate) n_removed: u64,
}

/// Writes what robots need of a store into a folder, or updates one. Robots that fetch meanwhile find the old
/// generation or the new one.
///
/// # Errors
/// [`StoreError`]; [`StoreError::ObjectHash`] for a damaged shard, before anything names it;
/// [`StoreError::Refused`] where robots would refuse the metadata, before anything is written.
pub(crate) fn export(store: &Path, to: &Path) -> Result<Exported, StoreError> {
    let mut n_tries = 0;
    let (reader, metadata) = loop {
        let reader = StoreReader::open(store)?;
        let metadata = verify::read_all(store)?;
        // The manifest is published before the metadata that names it.
        if !reader.is_current() {
            continue;
        }
        let refused = verify::refused_of(store, &metadata, &reader.current().bytes, clock_unix_secs());
        let Some(Refused { path, what }) = refused.into_iter().next() else { break (reader, metadata) };
        n_tries += 1;
        if n_tries == verify::N_TRIES {
            return Err(StoreError::Refused { path, what });
        }
        std::thread::sleep(verify::PAUSE);
    };
    let folder = to.join("v1");
    let [objects, targets, of_metadata] = ["objects", "targets", "metadata"].map(|name| folder.join(name));
    check_export(&folder, metadata.get(FIRST_ROOT))?;
    for folder in [&objects, &targets, &of_metadata] {
        fs_err::create_dir_all(folder)?;
    }
    let generations = || reader.previous().into_iter().chain([reader.current()]);
    let lens: BTreeMap<Hash32, u64> = generations().flat_map(Published::object_lens).collect();
    // Files on a stick or a server's disk may have been damaged since.
    let is_there = |hash: &Hash32| {
        files::hash_of(&objects.join(hash.to_string())).is_ok_and(|(found, _)| found == *hash)
    };
    let fresh: Vec<(&Hash32, &u64)> = lens.par_iter().filter(|(hash, _)| !is_there(hash)).collect();
    fresh.par_iter().try_for_each(|(hash, _)| {
        let bytes = reader.read_object(**hash)?;
        Ok::<_, StoreError>(durable::write(&objects.join(hash.to_string()), &bytes)?)
    })?;
    for published in generations() {
        // The name has no folder in it.
        if let Ok(name) = TargetFile::of(&published.bytes).file_name(manifest::TARGET) {
            durable::write(&targets.join(name), &published.bytes)?;
        }
    }
    // By name the timestamp comes last: roots, targets and snapshots are there before it names them.
    for (name, bytes) in &metadata {
        // What robots need was read, or the walk would have refused it.
        if let Ok(bytes) = bytes {
            durable::write(&of_metadata.join(name), bytes)?;
        }
    }
    durable::write(&folder.join(manifest::TARGET), &reader.current().bytes)?;
    let is_left_over = |name: &str| name.parse().is_ok_and(|hash: Hash32| !lens.contains_key(&hash));
    let (n_removed, _) = files::remove_files(&objects, is_left_over)?;
    let len_bytes = fresh.iter().map(|(_, len_bytes)| **len_bytes).sum();
    Ok(Exported { n_files: fresh.len(), len_bytes, n_removed })
}

/// Refuses a folder that has another store's export, or what no export has; hidden files may lie there. `root`: the
/// store's first.
fn check_export(folder: &Path, root: Option<&Result<Vec<u8>, TufError>>) -> Result<(), StoreError> {
    let refuse = |path: &Path, what| {
        let path = path.display();
        Err(StoreError::Failed(format!("{path}: {what}; name another folder with --out, or move this away")))
    };
    for part in ["", "objects", "targets", "metadata"] {
        let Some(entries) = files::if_there(fs_err::read_dir(folder.join(part)))? else { continue };
        for entry in entries {
            let entry = entry?;
            let found = entry.file_name().to_string_lossy().into_owned();
            let name = found.strip_suffix(".part").unwrap_or(&found);
            let is_ours = match (part, entry.path().is_dir()) {
                ("", true) => ["objects", "targets", "metadata"].contains(&name),
                ("", false) => name == manifest::TARGET,
                ("objects", false) => name.parse::<Hash32>().is_ok(),
                ("targets", false) => name.ends_with(".manifest"),
                ("metadata", false) => name.ends_with(".json"),
                _ => false,
            };
            if !is_ours && !found.starts_with('.') {
                return refuse(&entry.path(), "no export of a store has this");
            }
        }
    }
    let path = folder.join("metadata").join(FIRST_ROOT);
    let Some(exported) = files::if_there(fs_err::read(&path))? else { return Ok(()) };
    match root {
        Some(Ok(root)) if *root == exported => Ok(()),
        _ => refuse(&path, "robots follow another store here"),
    }
}
