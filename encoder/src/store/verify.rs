//! Reads every byte of what a store publishes, and follows its metadata as a robot does.

use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;
use serde::Serialize;
use slag_common::Hash32;
use slag_common::manifest::{Manifest, ShardRecord, TextModelRecord};

use super::reader::{Extras, StoreReader};
use super::walk::{self, Refused};
use super::{files, metadata};

/// Objects of the current and the previous generation: content of each, by hash and length if a manifest states it.
type Listing = BTreeMap<(Hash32, Option<u64>), Vec<String>>;

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Fault {
    Missing,
    /// Its content has another hash or length than the manifest lists.
    Damaged,
    /// It cannot be read; the system's error.
    Unreadable(String),
    /// Robots refuse it: why, and what helps.
    Refused(String),
}

/// A file that robots or queries would fail on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct BadFile {
    /// Of an object; absent of the manifest and of metadata.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) hash: Option<Hash32>,
    pub(crate) path: PathBuf,
    pub(crate) fault: Fault,
    /// What an object holds, such as `cell 3, balanced, generation 2`.
    pub(crate) holds: Vec<String>,
}

/// What was read, and what of it is bad.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Verified {
    /// Objects that the current generation and the one before it list.
    pub(crate) n_files: usize,
    pub(crate) len_bytes: u64,
    /// Bad objects, by hash; then what robots refuse of metadata and manifest.
    pub(crate) bad: Vec<BadFile>,
}

impl StoreReader {
    pub(crate) fn listing(&self) -> Listing {
        let mut listing = Listing::new();
        for published in std::iter::once(self.current()).chain(self.previous()) {
            let generation = published.manifest.generation;
            for (hash, len_bytes, what) in contents(&published.manifest, &published.extras) {
                listing
                    .entry((hash, len_bytes))
                    .or_default()
                    .push(format!("{what}, generation {generation}"));
            }
        }
        listing
    }

    /// Reads every object, several at a time, and the metadata. `on_read`: called after each, from any thread.
    pub(crate) fn verify(&self, on_read: impl Fn() + Sync) -> Verified {
        let listing = self.listing();
        let bytes_read = AtomicU64::new(0);
        let check = |((hash, len_bytes), holds): (&(Hash32, Option<u64>), &Vec<String>)| {
            let path = self.object_path(*hash);
            let fault = match files::hash_of(&path) {
                Ok((found, n)) => {
                    bytes_read.fetch_add(n, Ordering::Relaxed);
                    let is_sound = found == *hash && len_bytes.is_none_or(|expected| expected == n);
                    (!is_sound).then_some(Fault::Damaged)
                }
                Err(e) if e.kind() == io::ErrorKind::NotFound => Some(Fault::Missing),
                Err(e) => Some(Fault::Unreadable(e.to_string())),
            };
            on_read();
            fault.map(|fault| BadFile { hash: Some(*hash), path, fault, holds: holds.clone() })
        };
        let mut bad: Vec<BadFile> = listing.par_iter().filter_map(check).collect();
        let of = |path, fault| BadFile { hash: None, path, fault, holds: Vec::new() };
        let store = self.dir();
        match walk::refused(store) {
            Ok(refused) => {
                bad.extend(refused.into_iter().map(|Refused { path, what }| of(path, Fault::Refused(what))))
            }
            Err(e) => bad.push(of(metadata::folder(store), Fault::Unreadable(e.to_string()))),
        }
        Verified { n_files: listing.len(), len_bytes: bytes_read.into_inner(), bad }
    }
}

/// A generation's objects: hash, length if the manifest states it, and content.
pub(super) fn contents(manifest: &Manifest, extras: &Extras) -> Vec<(Hash32, Option<u64>, String)> {
    let shards = manifest.cells.iter().flat_map(|cell| {
        let of_profile = |(profile, shard): (&_, &ShardRecord)| {
            (shard.hash, Some(shard.len_bytes), format!("cell {}, {profile}", cell.cell_id))
        };
        cell.shards.iter().map(of_profile).collect::<Vec<_>>()
    });
    let text_model = manifest.encoder.text_model.iter().flat_map(TextModelRecord::objects);
    let text_model = text_model.map(|object| (object.hash, Some(object.len_bytes), "text model".to_owned()));
    let extras = extras.iter().map(|(name, hash)| (*hash, None, name.clone()));
    shards.chain(text_model).chain(extras).collect()
}
