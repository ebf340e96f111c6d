//! Verifies an offered manifest: keys, expiry, rollback, encoder.

use slag_common::Hash32;
use slag_common::manifest::{self, Manifest, TrustedKeys};

use super::download::{Client, ManifestAnswer};
use super::error::FetchError;
use super::records::Records;
use super::request::FetchRequest;
use crate::store::{Current, EdgeCache};

/// The keys and the scene accepted.
///
/// A robot that accepted a key also accepts the successor named by it. Once the successor has signed a
/// manifest, the old key is refused, even if a command line still names it: a key in the request chooses
/// among the accepted ones, and only a pair (accepted key, new key) adds one.
pub(super) struct Trust {
    /// Empty at the first contact.
    accepted: Vec<Hash32>,
    /// Keys and their accepted successors: those named by a manifest, and those given in the request.
    changes: Vec<(Hash32, Hash32)>,
    /// The only scene accepted; absent at the first contact.
    scene: Option<String>,
}

impl Trust {
    /// Determines what is accepted from the request, the records and, if these are lost or behind, the
    /// generation on board.
    pub fn new(
        request: &FetchRequest,
        records: &Records,
        old: Option<&Current>,
        on_board: Option<&Offer>,
    ) -> Result<Self, FetchError> {
        let asked: Vec<Hash32> = request.keys.iter().map(|key| records.successor(*key)).collect();
        if let Some(damage) = records.damage().filter(|_| asked.is_empty()) {
            return Err(damage.into());
        }
        let known_scene =
            records.scene().or(on_board.map(|offer| offer.manifest.scene.as_str())).map(str::to_owned);
        let scene = request.scene.clone().or(known_scene);
        let of_offer = |offer: &Offer| (offer.key, offer.manifest.next_key);
        let held = records.keys().or(on_board.map(of_offer)).or(old.map(|old| (old.key, None)));
        let held = match (held, on_board) {
            // The generation was switched, but the records of it are lost.
            (Some((_, Some(next))), Some(offer)) if offer.key == next => Some(of_offer(offer)),
            (held, _) => held,
        };
        let given = match asked[..] {
            [present, next] if present != next => Some((present, next)),
            _ => None,
        };
        let Some((key, next)) = held else {
            return Ok(Self { accepted: asked, changes: given.into_iter().collect(), scene });
        };
        let changes: Vec<(Hash32, Hash32)> =
            next.map(|next| (key, next)).into_iter().chain(given.filter(|(old, _)| *old == key)).collect();
        let mut accepted: Vec<Hash32> =
            std::iter::once(key).chain(changes.iter().map(|(_, next)| *next)).collect();
        if !asked.is_empty() {
            // A successor is accepted with its predecessor.
            let is_asked = |key: &Hash32| {
                asked.contains(key) || changes.iter().any(|(old, next)| next == key && asked.contains(old))
            };
            let held = accepted.clone();
            accepted.retain(is_asked);
            if accepted.is_empty() {
                return Err(FetchError::Key { asked: listed(&request.keys), held: listed(&held) });
            }
        }
        Ok(Self { accepted, changes, scene })
    }

    /// Returns whether any key will be accepted.
    pub fn is_first_contact(&self) -> bool {
        self.accepted.is_empty()
    }

    /// Returns the key that a signature by this key replaces.
    pub fn replaced_by(&self, key: Hash32) -> Option<Hash32> {
        self.changes.iter().find(|(_, next)| *next == key).map(|(old, _)| *old)
    }

    fn keys(&self) -> TrustedKeys {
        match self.is_first_contact() {
            true => TrustedKeys::FirstContact,
            false => TrustedKeys::Only(self.accepted.clone()),
        }
    }
}

fn listed(keys: &[Hash32]) -> String {
    keys.iter().map(Hash32::to_string).collect::<Vec<_>>().join(" or ")
}

/// A manifest with a valid signature.
pub(super) struct Offer {
    pub bytes: Vec<u8>,
    pub manifest_hash: Hash32,
    pub manifest: Manifest,
    pub key: Hash32,
}

impl Offer {
    /// Reads the manifest that `current` names; `None` if it is missing or invalid.
    pub fn on_board(cache: &EdgeCache, old: &Current) -> Option<Self> {
        let manifest_hash = old.manifest_hash;
        let bytes = cache.files().read(&cache.manifest_path(manifest_hash), manifest::MAX_BYTES).ok()?;
        let (manifest, key) = Manifest::verify(&bytes, &TrustedKeys::Only(vec![old.key])).ok()?;
        (Hash32::of(&bytes) == manifest_hash).then_some(Self { bytes, manifest_hash, manifest, key })
    }

    /// Downloads the store's manifest; offline, takes the one on board.
    pub fn get(
        client: &Client<'_>,
        offline: bool,
        on_board: Option<&Self>,
        trust: &Trust,
    ) -> Result<Self, FetchError> {
        let answer = match offline {
            true => ManifestAnswer::Unchanged,
            false => client.manifest(on_board.map(|offer| offer.manifest_hash))?,
        };
        let bytes = match (answer, on_board) {
            (ManifestAnswer::New(bytes), _) => bytes,
            (ManifestAnswer::Unchanged, Some(offer)) => offer.bytes.clone(),
            (ManifestAnswer::Unchanged, None) => {
                return Err(FetchError::NotGiven { what: "manifest", advice: "fetch once with network" });
            }
        };
        let (manifest, key) = Manifest::verify(&bytes, &trust.keys())?;
        Ok(Self { manifest_hash: Hash32::of(&bytes), bytes, manifest, key })
    }

    /// Refuses a manifest that is expired, of another scene or encoder, or older than one accepted before.
    pub fn check(
        &self,
        records: &Records,
        on_board: Option<&Self>,
        trust: &Trust,
        request: &FetchRequest,
        now_unix_secs: u64,
    ) -> Result<(), FetchError> {
        self.manifest.check_expiry(now_unix_secs)?;
        let (scene, offered) = (&self.manifest.scene, self.manifest.generation);
        if let Some(expected) = trust.scene.as_ref().filter(|expected| *expected != scene) {
            return Err(FetchError::Scene { expected: expected.clone(), offered: scene.clone() });
        }
        // A successor continues the generation count of its predecessor.
        let replaced = trust.replaced_by(self.key);
        let same_signer =
            |key: Hash32| key == self.key || Some(key) == replaced || trust.accepted.contains(&key);
        // The records may be lost; the manifest on board holds its generation too.
        let on_board = on_board.filter(|old| same_signer(old.key) && old.manifest.scene == *scene);
        let mut seen = on_board.map(|old| old.manifest.generation);
        for key in trust.accepted.iter().chain([&self.key]).chain(&replaced) {
            seen = seen.max(records.highest_generation(*key, scene));
        }
        if let Some(seen) = seen.filter(|seen| *seen > offered) {
            return Err(FetchError::Rollback { scene: scene.clone(), seen, offered });
        }
        let found = self.manifest.encoder.id;
        match request.expected_encoder {
            Some(expected) if expected != found => Err(FetchError::Encoder { expected, found }),
            _ => Ok(()),
        }
    }
}
