//! Verifies an offered manifest: keys, expiry, rollback, encoder.

use slag_common::Hash32;
use slag_common::manifest::{self, Manifest, TrustedKeys};

use super::download::{Client, ManifestAnswer};
use super::error::FetchError;
use super::records::{Records, RecordsError};
use super::request::FetchRequest;
use crate::store::{Current, EdgeCache};

/// The keys accepted.
///
/// A robot that accepted a key also accepts the successor named by it. Once the successor has signed a
/// manifest, the old key is refused, even if a command line still names it.
pub(super) struct Trust {
    /// Empty at the first contact.
    accepted: Vec<Hash32>,
    /// Keys and their accepted successors: those named by a manifest, and those given in the request.
    changes: Vec<(Hash32, Hash32)>,
}

impl Trust {
    /// Determines the accepted keys from the request, the records and, if these are lost or behind, the
    /// generation on board.
    pub fn new(
        asked: &[Hash32],
        records: &Records,
        old: Option<&Current>,
        on_board: Option<&Offer>,
    ) -> Result<Self, RecordsError> {
        let of_offer = |offer: &Offer| (offer.key, offer.manifest.next_key);
        let held = records.keys()?.or(on_board.map(of_offer)).or(old.map(|old| (old.key, None)));
        let held = match (held, on_board) {
            // The generation was switched, but the records of it are lost.
            (Some((_, Some(next))), Some(offer)) if offer.key == next => Some(of_offer(offer)),
            (held, _) => held,
        };
        let held = match held {
            // A power cut came between the records of a key change.
            Some((key, next)) => match records.successor(key)? {
                successor if successor == key => Some((key, next)),
                successor => Some((successor, None)),
            },
            None => None,
        };
        let mut accepted = match asked {
            [] => held.iter().map(|(key, _)| *key).collect(),
            asked => asked.iter().map(|key| records.successor(*key)).collect::<Result<Vec<_>, _>>()?,
        };
        let mut changes = Vec::new();
        if let (&[present, next], Some((key, _))) = (accepted.as_slice(), held)
            && present == key
            && present != next
        {
            changes.push((present, next));
        }
        if let Some((key, Some(next))) = held
            && accepted.contains(&key)
        {
            accepted.push(next);
            changes.push((key, next));
        }
        Ok(Self { accepted, changes })
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

    /// Refuses a manifest that is expired, older than one accepted before, or of another encoder.
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
        // A successor continues the generation count of its predecessor.
        let same_signer = |key: Hash32| key == self.key || trust.accepted.contains(&key);
        // The records may be lost; the manifest on board holds its generation too.
        let on_board = on_board.filter(|old| same_signer(old.key) && old.manifest.scene == *scene);
        let mut seen = on_board.map(|old| old.manifest.generation);
        for key in trust.accepted.iter().chain([&self.key]) {
            seen = seen.max(records.highest_generation(*key, scene)?);
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
