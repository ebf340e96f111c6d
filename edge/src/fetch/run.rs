//! A fetch, step by step.

use std::collections::BTreeSet;
use std::io;
use std::time::Instant;

use slag_common::Hash32;
use slag_common::manifest::{Manifest, ObjectRecord, TextModelRecord};
use slag_common::tuf::Kept;

use super::download::Client;
use super::environment::Environment;
use super::error::FetchError;
use super::generation::{Before, assemble};
use super::history;
use super::objects::{Check, download_all};
use super::offer::Offer;
use super::plan::{Object, Plan, Wanted};
use super::records::{LastFetch, Records, RecordsError};
use super::report::{FetchReport, Tally, TextModelTally};
use super::request::FetchRequest;
use super::scrub::{digests, scrub};
use super::staging::{clear_manifests, clear_staging, held_shards, part_path, put, staging};
use super::trust::trust_first;
use super::usage::Usage;
use crate::store::{Current, EdgeCache, StoreError, damaged};

/// Most bytes of a cell in `current`.
const CELL_BYTES: u64 = 512;
/// Space for records of fetches.
const SPARE_BYTES: u64 = 4096;

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
    let mut records = Records::open(cache)?;
    let mut usage = Usage::open(cache.dir().join("db"));
    // A killed fetch may have renamed files without syncing their folder.
    for dir in &dirs {
        cache.files().sync_dir(dir)?;
    }
    let last = records.last().cloned();
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
            tracing::warn!("{e}");
            None
        }
        other => other?,
    };
    let client = Client::new(&from, environment)?;
    let on_board = old.as_ref().and_then(|old| Offer::on_board(cache, old));
    let known_scene = records.scene().or(on_board.as_ref().map(|offer| offer.manifest.scene.as_str()));
    let scene = request.scene.as_deref().or(known_scene).map(str::to_owned);
    let mut is_first_contact = false;
    let offer = match request.offline {
        true => on_board
            .clone()
            .ok_or(FetchError::NotGiven { what: "manifest", advice: "fetch once with network" })?,
        false => {
            if let Some(damage) = records.damage() {
                return Err(damage.into());
            }
            if request.trust_first {
                is_first_contact = trust_first(&client, cache, &mut records)?;
            }
            let offer =
                Offer::get(&client, cache, &mut records, environment.now_unix_secs, on_board.as_ref());
            offer.map_err(|e| disk_full(e, SPARE_BYTES))?
        }
    };
    offer.check(scene.as_deref(), request)?;

    let centre_in_world = at.in_world(&offer.manifest)?;
    let mut held = held_shards(cache, &usage)?;
    let FetchRequest { profile, radius, max_bytes, .. } = *request;
    let wanted = Wanted { profile, centre_in_world, radius, max_bytes };
    let mut plan = Plan::new(&offer.manifest, &wanted, &held)?;
    let check = Check::new(&offer.manifest, profile, &plan.cells);
    let marked = damaged::marked(cache);
    let scrubbed = scrub(cache, &check, &plan.keep, &marked, &usage, environment.now_unix_secs);
    if !scrubbed.unfit.is_empty() {
        held.retain(|hash, _| !scrubbed.unfit.contains(hash));
        plan = Plan::new(&offer.manifest, &wanted, &held)?;
    }
    let planned = Tally::of(plan.download.iter().map(|object| object.len_bytes));
    if request.offline && planned.n_shards > 0 {
        return Err(FetchError::Offline { n_shards: planned.n_shards, bytes: planned.bytes });
    }
    let accepted = records.accept(cache, &LastFetch { from, at }, &offer.manifest.scene);
    accepted.map_err(|e| disk_full(e.into(), planned.bytes))?;

    let text_of = |offer: &Offer| text_model(&offer.manifest).map(|object| object.hash).collect::<Vec<_>>();
    let of_old = old.iter().flat_map(Current::shards).chain(on_board.iter().flat_map(text_of));
    let in_use: BTreeSet<Hash32> = of_old.collect();
    for hash in plan.free.difference(&in_use) {
        cache.files().remove(&cache.shard_path(*hash))?;
    }
    if let (Some(old), Some(on_board)) = (&old, &on_board) {
        history::note(cache, old, &on_board.manifest, offer.manifest_hash, &plan.cells);
    }
    clear_staging(cache, &plan.download)?;
    environment.progress.planned(planned.n_shards, planned.bytes);
    let before = Before { cache, current: old.as_ref(), offer: on_board.as_ref() };
    let work = || {
        let other_bytes = offer.bytes.len() as u64 + plan.cells.len() as u64 * CELL_BYTES + SPARE_BYTES;
        if let Err(error) = check_space(cache, &plan.download, other_bytes) {
            match history::forget(cache) {
                true => check_space(cache, &plan.download, other_bytes)?,
                false => return Err(error),
            }
        }
        let check = Check::new(&offer.manifest, profile, &plan.cells);
        let mut downloaded = download_all(cache, &client, &check, &plan.download, request.parallel)?;
        damaged::unmark(cache, marked.intersection(&downloaded.good))?;
        // Without its text model the scene would not answer; the generation on board does.
        let of_text_model = downloaded.bad.keys().find(|hash| check.is_of_text_model(**hash)).copied();
        if let Some((_, error)) = of_text_model.and_then(|hash| downloaded.bad.remove(&hash)) {
            return Err(error);
        }
        let current = assemble(before, &offer, &wanted, &plan, &downloaded.bad);
        for (hash, (_, error)) in &downloaded.bad {
            let cell_id = check.cell(*hash).map_or(0, |cell| cell.cell_id);
            tracing::warn!("cell {cell_id}: {}", crate::error_line(error));
        }
        if current.cells.is_empty() {
            let first = plan.download.iter().find_map(|object| downloaded.bad.remove(&object.hash));
            if let Some((_, error)) = first {
                return Err(error);
            }
        }
        // Readers open the generation again where a shard of it was replaced.
        if old.as_ref() != Some(&current) || !downloaded.good.is_empty() {
            put(cache, &offer.bytes, &cache.manifest_path(offer.manifest_hash))?;
            let bytes = serde_json::to_vec(&current).map_err(io::Error::from)?;
            put(cache, &bytes, &cache.current_path())?;
        }
        let sound = scrubbed.sound.iter().chain(&downloaded.good).copied();
        Ok((digests(cache, &check, sound), downloaded.good, current))
    };
    let (digests, downloaded, current) = work().map_err(|e| disk_full(e, planned.bytes))?;

    let in_use: BTreeSet<Hash32> = current.shards().chain(text_of(&offer)).collect();
    plan.free.retain(|hash| !in_use.contains(hash));
    for hash in &plan.free {
        cache.files().remove(&cache.shard_path(*hash))?;
    }
    let manifests = current.old_shards().map(|(_, old)| old.manifest_hash).chain([offer.manifest_hash]);
    clear_manifests(cache, &manifests.collect())?;
    clear_staging(cache, &[])?;
    let on_board: BTreeSet<Hash32> = in_use.iter().chain(&plan.spare).copied().collect();
    damaged::unmark(cache, marked.difference(&on_board))?;
    usage.finish(&in_use, &digests, &on_board, environment.now_unix_secs);
    let text: BTreeSet<Hash32> = text_of(&offer).into_iter().collect();
    let tally =
        |hashes: &BTreeSet<Hash32>| Tally::of(hashes.difference(&text).map(|hash| held[hash].len_bytes));
    let is_downloaded = |object: &&Object| downloaded.contains(&object.hash) && !text.contains(&object.hash);
    let text_model = offer.manifest.encoder.text_model.as_ref().map(|model| TextModelTally {
        bytes: model.objects().map(|object| object.len_bytes).sum(),
        downloaded_bytes: model
            .objects()
            .filter(|object| downloaded.contains(&object.hash))
            .map(|object| object.len_bytes)
            .sum(),
    });
    Ok(FetchReport {
        text_model,
        downloaded: Tally::of(plan.download.iter().filter(is_downloaded).map(|object| object.len_bytes)),
        kept: tally(&plan.keep),
        spare: tally(&plan.spare),
        freed: tally(&plan.free),
        scene: offer.manifest.scene,
        generation: offer.manifest.generation,
        manifest_hash: offer.manifest_hash,
        root_version: records.kept().and_then(Kept::root_version),
        is_first_contact,
        encoder_id: offer.manifest.encoder.id,
        encoder_name: offer.manifest.encoder.name,
        profile,
        centre_in_world,
        radius,
        n_cells: plan.cells.len(),
        bad_cells: current.bad_cells,
        resumed_bytes: client.resumed_bytes.into_inner(),
        retries: client.retries.into_inner(),
        seconds: started.elapsed().as_secs_f64(),
    })
}

/// Returns the objects of the text model that a scene carries.
fn text_model(manifest: &Manifest) -> impl Iterator<Item = ObjectRecord> + '_ {
    manifest.encoder.text_model.iter().flat_map(TextModelRecord::objects)
}

/// Refuses a download for which there is no space, before it begins. `other_bytes`: what is written besides.
fn check_space(cache: &EdgeCache, download: &[Object], other_bytes: u64) -> Result<(), FetchError> {
    let Some(free_bytes) = cache.files().free_bytes(cache.dir())? else { return Ok(()) };
    let mut needed_bytes = other_bytes;
    for Object { hash, len_bytes } in download {
        let staged_bytes = cache.files().stat(&part_path(cache, *hash))?.map_or(0, |stat| stat.len_bytes);
        needed_bytes = needed_bytes.saturating_add(len_bytes.saturating_sub(staged_bytes));
    }
    match !download.is_empty() && needed_bytes > free_bytes {
        true => Err(FetchError::NoSpace { path: cache.dir().to_owned(), needed_bytes, free_bytes }),
        false => Ok(()),
    }
}

/// Tells a full disk from other errors.
fn disk_full(error: FetchError, needed_bytes: u64) -> FetchError {
    let is_full =
        |e: &io::Error| matches!(e.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded);
    match error {
        FetchError::Io(source) | FetchError::Records(RecordsError::Io(source)) if is_full(&source) => {
            FetchError::DiskFull { needed_bytes, source }
        }
        error => error,
    }
}
