//! A fetch, step by step.

use std::collections::BTreeSet;
use std::io;
use std::time::Instant;

use slag_common::Hash32;

use super::download::Client;
use super::environment::Environment;
use super::error::FetchError;
use super::objects::{Check, download_all, unfit_objects};
use super::offer::{Offer, Trust};
use super::plan::{Plan, Wanted};
use super::records::{LastFetch, Records};
use super::report::{FetchReport, Tally};
use super::request::FetchRequest;
use super::staging::{clear_manifests, clear_staging, held_shards, put, staging};
use crate::store::{Current, EdgeCache, StoreError};

/// Fetches the shards within a radius and frees those beyond the budget.
///
/// # Errors
/// [`FetchError`]; the previous generation then still answers.
pub fn fetch(
    cache: &EdgeCache,
    request: &FetchRequest,
    environment: &Environment<'_>,
) -> Result<FetchReport, FetchError> {
    let started = Instant::now();
    let dirs =
        [staging(cache), cache.dir().join("shards"), cache.dir().join("manifests"), cache.dir().into()];
    for dir in dirs.iter().rev() {
        cache.files().create_dir(dir)?;
    }
    let records = Records::open(&cache.dir().join("db"))?;
    // A killed fetch may have renamed files without syncing their folder.
    for dir in &dirs {
        cache.files().sync_dir(dir)?;
    }
    let last = records.last()?;
    let (last_from, last_at) = last.map_or((None, None), |last| (Some(last.from), Some(last.at)));
    let from = request
        .from
        .clone()
        .or(last_from)
        .ok_or(FetchError::NotGiven { what: "store address", advice: "give one with --from URL" })?;
    let at = request.at.or(last_at).ok_or(FetchError::NotGiven {
        what: "position",
        advice: "give one with --at X,Y,Z or --at-geo LAT,LON",
    })?;
    let old = match cache.current() {
        Err(e @ StoreError::Current { .. }) => {
            tracing::warn!("{e}; it will be rewritten");
            None
        }
        other => other?,
    };
    let client = Client::new(&from, environment)?;
    let on_board = old.as_ref().and_then(|old| Offer::on_board(cache, old));
    let trust = Trust::new(&request.keys, &records, old.as_ref(), on_board.as_ref())?;
    let offer = Offer::get(&client, request.offline, on_board.as_ref(), &trust)?;
    offer.check(&records, on_board.as_ref(), &trust, request, environment.now_unix_secs)?;
    let replaced_key = trust.replaced_by(offer.key);

    let centre_in_world = at.in_world(&offer.manifest)?;
    let mut held = held_shards(cache, &records)?;
    let FetchRequest { profile, radius, max_bytes, .. } = *request;
    let wanted = Wanted { profile, centre_in_world, radius, max_bytes };
    let mut plan = Plan::new(&offer.manifest, &wanted, &held)?;
    let unfit = unfit_objects(cache, &Check::new(&offer.manifest, profile, &plan.cells), &plan.keep);
    if !unfit.is_empty() {
        held.retain(|hash, _| !unfit.contains(hash));
        plan = Plan::new(&offer.manifest, &wanted, &held)?;
    }
    let downloaded = Tally::of(plan.download.iter().map(|object| object.len_bytes));
    if request.offline && downloaded.n_shards > 0 {
        return Err(FetchError::Offline { n_shards: downloaded.n_shards, bytes: downloaded.bytes });
    }
    records.accept(&LastFetch { from, at }, &offer.manifest, offer.key, replaced_key.as_slice())?;
    if let Some(old) = replaced_key {
        tracing::info!("key {old} is no longer accepted: {} replaced it", offer.key);
    }

    let in_use: BTreeSet<Hash32> = old.iter().flat_map(|old| &old.cells).map(|cell| cell.hash).collect();
    for hash in plan.free.difference(&in_use) {
        cache.files().remove(&cache.shard_path(*hash))?;
    }
    clear_staging(cache, &plan.download)?;
    environment.progress.planned(downloaded.n_shards, downloaded.bytes);
    let work = || {
        let check = Check::new(&offer.manifest, profile, &plan.cells);
        download_all(cache, &client, &check, &plan.download, request.parallel)?;
        let Offer { manifest_hash, key, .. } = offer;
        let current =
            Current { manifest_hash, key, profile, centre_in_world, radius, cells: plan.cells.clone() };
        if old.as_ref() != Some(&current) {
            put(cache, &offer.bytes, &cache.manifest_path(manifest_hash))?;
            let bytes = serde_json::to_vec(&current).map_err(io::Error::from)?;
            put(cache, &bytes, &cache.current_path())?;
        }
        Ok(())
    };
    work().map_err(|e| match e {
        FetchError::Io(source) if is_disk_full(&source) => {
            // A full disk affects other programs: free the space, though the next fetch starts over.
            match clear_staging(cache, &[]) {
                Ok(()) => FetchError::DiskFull { needed_bytes: downloaded.bytes, source },
                Err(e) => e,
            }
        }
        other => other,
    })?;

    for hash in &plan.free {
        cache.files().remove(&cache.shard_path(*hash))?;
    }
    clear_manifests(cache, offer.manifest_hash)?;
    clear_staging(cache, &[])?;
    records.finish(plan.cells.iter().map(|cell| cell.hash), plan.free.iter().copied())?;
    let tally = |hashes: &BTreeSet<Hash32>| Tally::of(hashes.iter().map(|hash| held[hash].len_bytes));
    Ok(FetchReport {
        scene: offer.manifest.scene,
        generation: offer.manifest.generation,
        manifest_hash: offer.manifest_hash,
        key: offer.key,
        next_key: offer.manifest.next_key,
        replaced_key,
        is_first_contact: trust.is_first_contact(),
        encoder_id: offer.manifest.encoder.id,
        encoder_name: offer.manifest.encoder.name,
        profile,
        centre_in_world,
        radius,
        n_cells: plan.cells.len(),
        downloaded,
        kept: tally(&plan.keep),
        spare: tally(&plan.spare),
        freed: tally(&plan.free),
        resumed_bytes: client.resumed_bytes.into_inner(),
        retries: client.retries.into_inner(),
        seconds: started.elapsed().as_secs_f64(),
    })
}

fn is_disk_full(e: &io::Error) -> bool {
    matches!(e.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}
