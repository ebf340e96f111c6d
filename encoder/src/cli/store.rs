//! `store`: what a store holds, whether it is whole, and what can go.

use std::fmt::{self, Write};
use std::path::PathBuf;

use anyhow::Result;
use clap::{Args, Subcommand};
use serde::Serialize;
use slag_common::Hash32;
use slag_common::byte_size::ByteSize;
use slag_common::tuf::format_utc;

use super::common;
use super::common::{Exit, print, warn_of_expiry};
use crate::encode::{JobStatus, job_status};
use crate::progress::Progress;
use crate::store::metadata::{Metadata, TIMESTAMP_DAYS, signing_unix_secs};
use crate::store::{
    CatalogueCopy, Exported, Fault, GenerationRecord, Published, Store, StoreReader, Verified, export,
};

/// `store`.
#[derive(Debug, Subcommand)]
pub enum StoreCommand {
    /// Lists the generations of a store with their cells and bytes.
    Ls(StoreArgs),
    /// Reads every byte that a store publishes, follows its metadata as a robot does, and names what is damaged or
    /// missing: another encode writes it anew.
    Verify(StoreArgs),
    /// Removes what neither the current generation nor the one before it needs.
    Gc(StoreArgs),
    /// Writes the store as static files, from which robots fetch over any web server; again after each encode and
    /// refresh.
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
            match CatalogueCopy::of(&at.store, &std::env::temp_dir())? {
                Some(CatalogueCopy { catalogue, .. }) => {
                    listed.history = catalogue.generations()?;
                    listed.job = job_status(catalogue.db())?;
                }
                None => tracing::warn!(
                    "without the history: the catalogue db/ is not there, damaged, or being changed"
                ),
            }
            print(json, &listed, &listed)?;
            Ok(Exit::Done)
        }
        StoreCommand::Verify(at) => {
            let reader = StoreReader::open(&at.store)?;
            progress.begin("verify", "file", reader.listing().len() as u64, 0);
            let verified = reader.verify(|| progress.advance(1));
            progress.end();
            warn_of_expiry(&at.store);
            print(json, &verified, lines(&verified)?)?;
            Ok(if verified.bad.is_empty() { Exit::Done } else { Exit::Failed })
        }
        StoreCommand::Gc(at) => {
            // A mistyped path must not create a store.
            StoreReader::open(&at.store)?;
            let pruned = Store::create_or_open(&at.store)?.prune()?;
            let lines = format!("{} files removed, {}\n", pruned.n_files, ByteSize(pruned.len_bytes));
            print(json, &pruned, lines)?;
            Ok(Exit::Done)
        }
        StoreCommand::Export { at, out } => {
            common::check([out.as_path()], &[], Some(&at.store))?;
            let exported = export(&at.store, out)?;
            let Exported { n_files, len_bytes, n_removed } = exported;
            let lines = format!("{n_files} objects written, {}; {n_removed} removed\n", ByteSize(len_bytes));
            print(json, &exported, lines)?;
            Ok(Exit::Done)
        }
        StoreCommand::Refresh { at, days } => {
            // A mistyped path must not create a store.
            StoreReader::open(&at.store)?;
            let refreshed = Metadata::open(&at.store)?.refresh(signing_unix_secs(), *days)?;
            let expires = format_utc(refreshed.expires_unix_secs);
            let line = format!("timestamp {} until {expires}\n", refreshed.timestamp_version);
            warn_of_expiry(&at.store);
            print(json, &refreshed, line)?;
            Ok(Exit::Done)
        }
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
    n_files: usize,
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
            n_files: shards.len() + published.extras.len(),
            shard_bytes: shards.values().sum(),
        }
    }
}

impl fmt::Display for Listed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for generation in std::iter::once(&self.current).chain(&self.previous) {
            let Generation { scene, generation, encoder, n_cells, n_gaussians, n_files, shard_bytes, .. } =
                generation;
            let bytes = ByteSize(*shard_bytes);
            writeln!(
                f,
                "generation {generation} of {scene}: {n_gaussians} Gaussians in {n_cells} cells by {encoder}, {n_files} files, {bytes} of shards"
            )?;
        }
        if let (Some(first), n @ 3..) = (self.history.first(), self.history.len()) {
            writeln!(f, "{n} generations since generation {}", first.generation)?;
        }
        if let Some(JobStatus { n_views, is_published, step, .. }) = &self.job {
            let step = step.as_deref().unwrap_or("begin");
            match is_published {
                true => writeln!(f, "contributions of {n_views} views are kept")?,
                false => writeln!(f, "unfinished encode: {n_views} views done, at step {step}")?,
            }
        }
        Ok(())
    }
}

fn lines(verified: &Verified) -> Result<String, fmt::Error> {
    let mut lines = String::new();
    let Verified { n_files, len_bytes, bad } = verified;
    for object in bad {
        let path = object.path.display();
        match &object.fault {
            Fault::Missing => write!(lines, "{path}: missing")?,
            Fault::Damaged => write!(lines, "{path}: damaged")?,
            Fault::Unreadable(error) => write!(lines, "{path}: {error}")?,
            Fault::Refused(what) => write!(lines, "{path}: robots refuse it: {what}")?,
        }
        match object.holds.is_empty() {
            true => writeln!(lines)?,
            false => writeln!(lines, " ({})", object.holds.join("; "))?,
        }
    }
    write!(lines, "{n_files} files, {} read, {} bad", ByteSize(*len_bytes), bad.len())?;
    // Faults of metadata carry their own remedy.
    let has_objects = bad.iter().any(|file| file.hash.is_some());
    lines += if has_objects { "; another encode into this store writes objects anew\n" } else { "\n" };
    Ok(lines)
}
