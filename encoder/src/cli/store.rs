//! `store`: what a store holds, whether it is whole, and what can go.

use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow};
use clap::{Args, Subcommand};
use serde::Serialize;
use slag_common::Hash32;
use slag_common::byte_size::ByteSize;
use slag_common::tuf::format_utc;

use super::common::print;
use super::encode;
use super::exit::Exit;
use crate::encode::{JobStatus, job_status};
use crate::progress::Progress;
use crate::store::metadata::{Metadata, TIMESTAMP_DAYS, clock_unix_secs};
use crate::store::{
    BadObject, Exported, Fault, GenerationRecord, Published, Store, StoreReader, Verified, export,
};

/// `store`.
#[derive(Debug, Subcommand)]
pub enum StoreCommand {
    /// Lists the generations of a store with their cells and bytes.
    Ls(StoreArgs),
    /// Reads every byte that a store publishes, and names what is damaged or missing. `repair` and `encode` write it anew.
    Verify(StoreArgs),
    /// Makes what is damaged or missing again: the catalogue and metadata from the manifest, objects from the views that
    /// the encode kept (`--keep-views`), by the command that the catalogue has of it.
    ///
    /// Publishes nothing: robots fetch the same files as before.
    Repair(StoreArgs),
    /// Removes what neither the current generation nor the one before it needs.
    Gc(StoreArgs),
    /// Writes the store as static files, from which robots fetch over any web server; again after each encode and refresh.
    Export {
        /// The store.
        #[command(flatten)]
        at: StoreArgs,
        /// Folder that the web server serves; what robots ask for lies under `v1/`.
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
    /// Signs a new timestamp, so that clients can tell a store without news from one that hides them.
    ///
    /// For a timer; an encode that runs is no hindrance.
    Refresh {
        /// The store.
        #[command(flatten)]
        at: StoreArgs,
        /// Days for which clients accept it.
        #[arg(long, value_name = "N", default_value_t = TIMESTAMP_DAYS, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
    },
}

/// The store meant.
#[derive(Debug, Args)]
pub struct StoreArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
}

pub(super) fn run(command: &StoreCommand, progress: &dyn Progress, json: bool) -> Result<Exit> {
    match command {
        StoreCommand::Ls(at) => {
            let reader = StoreReader::open(&at.store)?;
            let of = |published: &Published| Generation::of(published);
            let mut listed = Listed {
                current: of(reader.current()),
                previous: reader.previous().map(of),
                history: Vec::new(),
                job: None,
            };
            match Store::create_or_open(&at.store) {
                Ok(store) => {
                    listed.history = store.generations()?;
                    listed.job = job_status(&store)?;
                }
                // An encode may run; manifests are there in any case.
                Err(error) => tracing::warn!("without the catalogue: {error}"),
            }
            print(json, &listed, &listed)?;
            Ok(Exit::Done)
        }
        StoreCommand::Verify(at) => {
            let reader = StoreReader::open(&at.store)?;
            let listing = reader.listing();
            progress.begin("verify", "object", listing.n_objects() as u64, 0);
            let verified = listing.verify(|| progress.advance(1));
            progress.end();
            print(json, &verified, Lines(&verified))?;
            Ok(if verified.bad.is_empty() { Exit::Done } else { Exit::Failed })
        }
        StoreCommand::Repair(at) => repair(&at.store, progress, json),
        StoreCommand::Gc(at) => {
            // A mistyped path must not create a store.
            StoreReader::open(&at.store)?;
            let pruned = Store::create_or_open(&at.store)?.prune()?;
            let lines = format!("{} objects removed, {}\n", pruned.n_objects, ByteSize(pruned.len_bytes));
            print(json, &pruned, lines)?;
            Ok(Exit::Done)
        }
        StoreCommand::Export { at, out } => {
            let exported = export(&at.store, out)?;
            let Exported { n_objects, len_bytes, n_removed } = exported;
            let lines =
                format!("{n_objects} objects written, {}; {n_removed} removed\n", ByteSize(len_bytes));
            print(json, &exported, lines)?;
            Ok(Exit::Done)
        }
        StoreCommand::Refresh { at, days } => {
            // A mistyped path must not create a store.
            StoreReader::open(&at.store)?;
            let refreshed = Metadata::open(&at.store)?.refresh(clock_unix_secs(), *days)?;
            let expires = format_utc(refreshed.expires_unix_secs);
            let line = format!("timestamp {} until {expires}\n", refreshed.timestamp_version);
            print(json, &refreshed, line)?;
            Ok(Exit::Done)
        }
    }
}

/// Verifies, makes again what is bad, and verifies that.
fn repair(path: &Path, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let reader = StoreReader::open(path)?;
    // Mends metadata and catalogue on its way.
    let store = Store::create_or_open(path)?;
    let verify = || {
        let listing = reader.listing();
        progress.begin("verify", "object", listing.n_objects() as u64, 0);
        let verified = listing.verify(|| progress.advance(1));
        progress.end();
        verified
    };
    let before = verify();
    let generation = reader.manifest().generation;
    let record = store.generations()?.into_iter().find(|record| record.generation == generation);
    drop(store);
    let mut failure = None;
    if !before.bad.is_empty() {
        let command = record.and_then(|record| record.command);
        let remade = match &command {
            Some(command) => encode::remake(command, path, progress),
            None => Err(anyhow!("the command that made generation {generation} is not known")),
        };
        failure = remade.err().map(|error| format!("{error:#}"));
    }
    let after = if before.bad.is_empty() { before.clone() } else { verify() };
    let is_mended = |bad: &&BadObject| after.bad.iter().all(|still| still.hash != bad.hash);
    let repaired = Repaired {
        n_objects: after.n_objects,
        mended: before.bad.iter().filter(is_mended).cloned().collect(),
        bad: after.bad,
        failure,
    };
    print(json, &repaired, &repaired)?;
    Ok(if repaired.bad.is_empty() { Exit::Done } else { Exit::Failed })
}

/// The result of a repair.
#[derive(Serialize)]
struct Repaired {
    n_objects: usize,
    /// Objects that were bad and are whole.
    mended: Vec<BadObject>,
    /// Objects that still are bad.
    bad: Vec<BadObject>,
    /// Why nothing could be made again.
    failure: Option<String>,
}

impl fmt::Display for Repaired {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for object in &self.mended {
            writeln!(f, "{}: made again ({})", object.path.display(), object.holds.join("; "))?;
        }
        for object in &self.bad {
            writeln!(f, "{}: still bad ({})", object.path.display(), object.holds.join("; "))?;
        }
        if let Some(failure) = &self.failure {
            writeln!(f, "nothing was made again: {failure}")?;
        }
        writeln!(f, "{} objects, {} made again, {} bad", self.n_objects, self.mended.len(), self.bad.len())
    }
}

#[derive(Serialize)]
struct Listed {
    current: Generation,
    previous: Option<Generation>,
    /// Every generation ever published, from the catalogue.
    history: Vec<GenerationRecord>,
    /// The encode that the store keeps views of.
    job: Option<JobStatus>,
}

#[derive(Serialize)]
struct Generation {
    scene: String,
    generation: u64,
    manifest_hash: Hash32,
    created_unix_secs: u64,
    encoder: String,
    n_cells: usize,
    n_gaussians: u64,
    n_objects: usize,
    shard_bytes: u64,
}

impl Generation {
    fn of(published: &Published) -> Self {
        let manifest = &published.manifest;
        let shards = published.shard_lens();
        Self {
            scene: manifest.scene.clone(),
            generation: manifest.generation,
            manifest_hash: published.hash,
            created_unix_secs: manifest.created_unix_secs,
            encoder: manifest.encoder.name.clone(),
            n_cells: manifest.cells.len(),
            n_gaussians: manifest.cells.iter().map(|cell| u64::from(cell.n_gaussians)).sum(),
            n_objects: shards.len() + published.extras.len(),
            shard_bytes: shards.values().sum(),
        }
    }
}

impl fmt::Display for Listed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for generation in std::iter::once(&self.current).chain(&self.previous) {
            let Generation {
                scene, generation, encoder, n_cells, n_gaussians, n_objects, shard_bytes, ..
            } = generation;
            let bytes = ByteSize(*shard_bytes);
            writeln!(
                f,
                "generation {generation} of {scene}: {n_gaussians} Gaussians in {n_cells} cells by {encoder}, {n_objects} objects, {bytes} of shards"
            )?;
        }
        if let (Some(first), n @ 3..) = (self.history.first(), self.history.len()) {
            writeln!(f, "{n} generations since generation {}", first.generation)?;
        }
        if let Some(JobStatus { n_views, is_published, step }) = &self.job {
            let step = step.as_deref().unwrap_or("begin");
            match is_published {
                true => writeln!(f, "contributions of {n_views} views are kept")?,
                false => writeln!(f, "unfinished encode: {n_views} views done, at step {step}")?,
            }
        }
        Ok(())
    }
}

struct Lines<'a>(&'a Verified);

impl fmt::Display for Lines<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Verified { n_objects, len_bytes, bad } = self.0;
        for object in bad {
            let fault = match &object.fault {
                Fault::Missing => "missing",
                Fault::Damaged => "damaged",
                Fault::Unreadable(error) => error,
            };
            writeln!(f, "{}: {fault} ({})", object.path.display(), object.holds.join("; "))?;
        }
        write!(f, "{n_objects} objects, {} read, {} bad", ByteSize(*len_bytes), bad.len())?;
        writeln!(
            f,
            "{}",
            if bad.is_empty() { "" } else { "; `store repair` or another encode writes what is bad anew" }
        )
    }
}
