//! A fetch by phases: the cache is locked, an offer accepted, each shard's action decided; then files change.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::time::Instant;

use slag_common::Hash32;
use slag_common::manifest::ObjectRecord;
use slag_common::tuf::Kept;

use super::download::Client;
use super::error::FetchError;
use super::generation::{self, Before};
use super::objects::{Check, Downloaded, download_all};
use super::offer::Offer;
use super::plan::{Held, Plan, Wanted};
use super::records::{LastFetch, Records, RecordsError};
use super::request::{Environment, FetchReport, FetchRequest, Tally, TextModelTally};
use super::staging::{Usage, clear_manifests, clear_staging, part_path, put, remove, staging};
use super::trust::trust_first;
use crate::store::{Current, EdgeCache, StoreError};

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
    let mut fetch = Fetch::begin(cache, request, environment)?;
    let mut planned = fetch.plan()?;
    let needed_bytes = planned.plan.to_download().bytes;
    let brought = fetch.make_room(&planned).and_then(|()| fetch.bring(&planned));
    let (current, downloaded) = brought.map_err(|e| disk_full(e, needed_bytes))?;
    fetch.clean_up(&mut planned, &current)?;
    let report = fetch.report(planned, current, &downloaded);
    Ok(FetchReport { seconds: started.elapsed().as_secs_f64(), ..report })
}

/// The cache is locked and its content known.
struct Fetch<'a> {
    cache: &'a EdgeCache,
    request: &'a FetchRequest,
    environment: &'a Environment<'a>,
    client: Client<'a>,
    records: Records,
    usage: Usage,
    last: LastFetch,
    current: Option<Current>,
    on_board: Option<Offer>,
}

impl<'a> Fetch<'a> {
    fn begin(
        cache: &'a EdgeCache,
        request: &'a FetchRequest,
        environment: &'a Environment<'a>,
    ) -> Result<Self, FetchError> {
        let dirs =
            [cache.dir().into(), cache.dir().join("manifests"), cache.dir().join("shards"), staging(cache)];
        for dir in &dirs {
            cache.create_dir(dir)?;
        }
        let records = Records::open(cache)?;
        // A killed fetch may have renamed files without syncing their folder.
        for dir in dirs.iter().rev() {
            cache.files().sync_dir(dir)?;
        }
        let last = match (&request.from, request.at, &records.record.last) {
            (from, at, Some(last)) => {
                LastFetch { from: from.as_ref().unwrap_or(&last.from).clone(), at: at.unwrap_or(last.at) }
            }
            (Some(from), Some(at), None) => LastFetch { from: from.clone(), at },
            (from, ..) => {
                let (what, advice) = match from {
                    None => ("store address", "give one with --from URL"),
                    Some(_) => ("position", "give one with --at X,Y,Z or --at-geo LAT,LON"),
                };
                let what = format!("no {what} is given, and no earlier fetch recorded one; {advice}");
                return Err(FetchError::Request(what));
            }
        };
        let current = match cache.current() {
            Err(e @ (StoreError::Current { .. } | StoreError::Unreadable(_))) => {
                tracing::warn!("{e}");
                None
            }
            other => other?,
        };
        Ok(Self {
            client: Client::new(&last.from, environment)?,
            usage: Usage::open(cache),
            on_board: current.as_ref().and_then(|current| Offer::on_board(cache, current)),
            cache,
            request,
            environment,
            records,
            last,
            current,
        })
    }

    /// Updates metadata and takes its manifest if it is of the robot's scene. Returns whether its root was trusted just
    /// now.
    fn accept_offer(&mut self) -> Result<(Offer, bool), FetchError> {
        let Self { cache, request, client, records, on_board, .. } = self;
        if let Some(damage) = records.damage() {
            return Err(damage.into());
        }
        let is_first_contact = request.trust_first && trust_first(client, cache, records)?;
        let now_unix_secs = self.environment.now_unix_secs;
        let offer = Offer::get(client, cache, records, now_unix_secs, on_board.as_ref());
        let offer = offer.map_err(|e| disk_full(e, SPARE_BYTES))?;
        let of_board = on_board.as_ref().map(|offer| offer.manifest.scene.as_str());
        offer.check(request.scene.as_deref().or(records.record.scene.as_deref()).or(of_board))?;
        Ok((offer, is_first_contact))
    }

    /// Decides what to download, keep and free. Shards marked as damaged are downloaded again, as are those that the
    /// manifest describes otherwise than their own did.
    fn plan(&mut self) -> Result<Planned, FetchError> {
        let (offer, is_first_contact) = self.accept_offer()?;
        let Self { cache, request, usage, last, on_board, .. } = self;
        let manifest = &offer.manifest;
        let FetchRequest { profile, radius, max_bytes, .. } = **request;
        let wanted = Wanted { profile, centre_in_world: last.at.in_world(manifest)?, radius, max_bytes };
        let mut held = usage.held_shards(cache)?;
        let mut plan = Plan::new(manifest, &wanted, &held)?;
        let marked = cache.marked_as_damaged();
        let check = Check::new(manifest, profile, &plan.cells);
        let is_unfit =
            |hash: &Hash32| marked.contains(hash) || !check.is_fit(cache, on_board.as_ref(), *hash);
        let unfit: BTreeSet<Hash32> = plan.keep.iter().copied().filter(is_unfit).collect();
        if !unfit.is_empty() {
            held.retain(|hash, _| !unfit.contains(hash));
            plan = Plan::new(manifest, &wanted, &held)?;
        }
        Ok(Planned { offer, is_first_contact, wanted, held, plan, marked })
    }

    fn make_room(&mut self, Planned { offer, plan, .. }: &Planned) -> Result<(), FetchError> {
        let Self { cache, current, on_board, .. } = self;
        self.records.accept(cache, &self.last, &offer.manifest.scene)?;
        let old_shards = current.iter().flat_map(Current::shards);
        let in_use: BTreeSet<Hash32> =
            old_shards.chain(on_board.iter().flat_map(Offer::text_model)).collect();
        for hash in plan.free.difference(&in_use) {
            remove(cache, &cache.shard_path(*hash))?;
        }
        if let (Some(old), Some(on_board)) = (current, on_board) {
            generation::remember(cache, old, &on_board.manifest, offer.manifest_hash, &plan.cells);
        }
        clear_staging(cache, &plan.download)?;
        self.environment.progress.planned(plan.to_download().bytes);
        let other_bytes = offer.bytes.len() as u64 + plan.cells.len() as u64 * CELL_BYTES + SPARE_BYTES;
        match check_space(cache, &plan.download, other_bytes) {
            Err(_) if generation::forget_earlier(cache) => check_space(cache, &plan.download, other_bytes),
            checked => checked,
        }
    }

    /// Downloads, and replaces `current`. Unavailable cells are left out.
    fn bring(&self, planned: &Planned) -> Result<(Current, Downloaded), FetchError> {
        let Self { cache, current: old, on_board, .. } = self;
        let Planned { offer, wanted, plan, marked, .. } = planned;
        let check = Check::new(&offer.manifest, wanted.profile, &plan.cells);
        let parallel = self.request.parallel;
        let mut downloaded = download_all(cache, &self.client, &check, &plan.download, parallel)?;
        cache.unmark(marked.intersection(&downloaded.good))?;
        // Without its text model the new scene would not answer; the one on board does.
        let of_text_model = downloaded.bad.keys().find(|hash| check.is_of_text_model(**hash)).copied();
        if let Some((_, error)) = of_text_model.and_then(|hash| downloaded.bad.remove(&hash)) {
            return Err(error);
        }
        let before = Before { cache, current: old.as_ref(), offer: on_board.as_ref() };
        let current = generation::assemble(before, offer, wanted, plan, &downloaded.bad);
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
        // Readers reopen the generation if any file was replaced, even the manifest alone.
        let is_same = old.as_ref() == Some(&current) && on_board.is_some();
        if !is_same || !downloaded.good.is_empty() {
            put(cache, &offer.bytes, &cache.manifest_path(offer.manifest_hash))?;
            let bytes = serde_json::to_vec(&current).map_err(io::Error::from)?;
            put(cache, &bytes, &cache.current_path())?;
        }
        Ok((current, downloaded))
    }

    fn clean_up(&mut self, planned: &mut Planned, current: &Current) -> Result<(), FetchError> {
        let cache = self.cache;
        let Planned { offer, plan, marked, .. } = planned;
        let in_use: BTreeSet<Hash32> = current.shards().chain(offer.text_model()).collect();
        plan.free.retain(|hash| !in_use.contains(hash));
        for hash in &plan.free {
            remove(cache, &cache.shard_path(*hash))?;
        }
        let old_manifests = current.old_shards().map(|(_, old)| old.manifest_hash);
        clear_manifests(cache, &old_manifests.chain([offer.manifest_hash]).collect())?;
        clear_staging(cache, &[])?;
        let on_board = &in_use | &plan.spare;
        cache.unmark(marked.difference(&on_board))?;
        std::mem::take(&mut self.usage).finish(cache, &in_use, &on_board);
        Ok(())
    }

    fn report(self, planned: Planned, current: Current, downloaded: &Downloaded) -> FetchReport {
        let Planned { offer, is_first_contact, wanted, held, plan, .. } = planned;
        let text: BTreeSet<Hash32> = offer.text_model().collect();
        let of_held =
            |hashes: &BTreeSet<Hash32>| Tally::of(hashes.difference(&text).map(|hash| held[hash].len_bytes));
        let new_bytes =
            |object: &ObjectRecord| downloaded.good.contains(&object.hash).then_some(object.len_bytes);
        let shards = plan.download.iter().filter(|object| !text.contains(&object.hash));
        let text_model = offer.manifest.encoder.text_model.as_ref().map(|model| {
            let (all, new) = model.objects().fold((0, 0), |(all, new), object| {
                (all + object.len_bytes, new + new_bytes(&object).unwrap_or(0))
            });
            TextModelTally { bytes: all, downloaded_bytes: new }
        });
        let (resumed_bytes, retries) = self.client.resumed_bytes_and_retries();
        FetchReport {
            text_model,
            downloaded: Tally::of(shards.filter_map(new_bytes)),
            kept: of_held(&plan.keep),
            spare: of_held(&plan.spare),
            freed: of_held(&plan.free),
            generation: offer.manifest.generation,
            manifest_hash: offer.manifest_hash,
            root_version: self.records.record.kept.as_ref().and_then(Kept::root_version).unwrap_or(0),
            is_first_contact,
            encoder_id: offer.manifest.encoder.id,
            encoder_name: offer.manifest.encoder.name,
            scene: offer.manifest.scene,
            profile: wanted.profile,
            centre_in_world: wanted.centre_in_world,
            radius: wanted.radius,
            n_cells: plan.cells.len(),
            bad_cells: current.bad_cells,
            resumed_bytes,
            retries,
            seconds: 0.0,
        }
    }
}

/// The manifest is accepted and each shard's action decided; nothing was removed yet.
struct Planned {
    offer: Offer,
    is_first_contact: bool,
    wanted: Wanted,
    held: BTreeMap<Hash32, Held>,
    plan: Plan,
    marked: BTreeSet<Hash32>,
}

/// Refuses a download without enough space, before it begins. `other_bytes`: other writes.
fn check_space(cache: &EdgeCache, download: &[ObjectRecord], other_bytes: u64) -> Result<(), FetchError> {
    let free_bytes = cache.files().free_bytes(cache.dir())?;
    let missing_bytes = |ObjectRecord { hash, len_bytes }: &ObjectRecord| {
        let staged = cache.files().stat(&part_path(cache, *hash)).ok().flatten();
        len_bytes.saturating_sub(staged.map_or(0, |stat| stat.len_bytes))
    };
    let needed_bytes = download.iter().map(missing_bytes).fold(other_bytes, u64::saturating_add);
    match !download.is_empty() && needed_bytes > free_bytes {
        true => Err(FetchError::NoSpace { path: cache.dir().to_owned(), needed_bytes, free_bytes }),
        false => Ok(()),
    }
}

fn disk_full(error: FetchError, needed_bytes: u64) -> FetchError {
    let is_full =
        |e: &io::Error| matches!(e.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded);
    match error {
        FetchError::Io(source) | FetchError::Records(RecordsError::Io(source)) if is_full(&source) => {
            // Records and manifests need space, too.
            FetchError::DiskFull { needed_bytes: needed_bytes.max(1 << 20), source }
        }
        error => error,
    }
}
