//! A store's offer: updates its metadata, and downloads the named manifest if it is new.

use slag_common::Hash32;
use slag_common::manifest::{self, Manifest, ManifestError, TextModelRecord};
use slag_common::tuf::{Source, TargetFile, TufError, refresh};

use super::download::Client;
use super::error::FetchError;
use super::records::Records;
use crate::store::{Current, EdgeCache};

/// A manifest named by the store's metadata.
#[derive(Clone)]
pub(super) struct Offer {
    pub bytes: Vec<u8>,
    pub manifest_hash: Hash32,
    pub manifest: Manifest,
}

impl Offer {
    /// Reads the manifest of `current`; `None` if missing or invalid.
    pub fn on_board(cache: &EdgeCache, old: &Current) -> Option<Self> {
        let manifest_hash = old.manifest_hash;
        let bytes = cache.files().read(&cache.manifest_path(manifest_hash), manifest::MAX_BYTES).ok()?;
        let manifest = Manifest::parse(&bytes).ok()?;
        let bytes = bytes.to_vec();
        (Hash32::of(&bytes) == manifest_hash).then_some(Self { bytes, manifest_hash, manifest })
    }

    /// Durably updates the store's accepted metadata; returns the manifest it names, `on_board` if that is the same.
    pub fn get(
        client: &Client<'_>,
        cache: &EdgeCache,
        records: &mut Records,
        now_unix_secs: u64,
        on_board: Option<&Self>,
    ) -> Result<Self, FetchError> {
        let no_trust = || FetchError::NoTrust { from: client.base.clone() };
        let mut kept = records.record.kept.clone().ok_or_else(no_trust)?;
        let mut source = StoreMetadata { client, failure: None };
        let trusted = refresh(&mut kept, &mut source, now_unix_secs);
        // Even before a failure: a root that names new keys must not be forgotten.
        records.keep(cache, &kept)?;
        let trusted = trusted.map_err(|e| source.failure.take().unwrap_or(e.into()))?;
        let missing = || TufError::Missing { what: format!("the target {}", manifest::TARGET) };
        let target = trusted.target(manifest::TARGET).ok_or_else(missing)?;
        match on_board.filter(|offer| target.check(manifest::TARGET, &offer.bytes).is_ok()) {
            Some(offer) => Ok(offer.clone()),
            None => Self::download(client, target),
        }
    }

    fn download(client: &Client<'_>, target: &TargetFile) -> Result<Self, FetchError> {
        if target.length > manifest::MAX_BYTES {
            return Err(ManifestError::TooLong { len_bytes: target.length }.into());
        }
        let path = format!("targets/{}", target.file_name(manifest::TARGET)?);
        let missing = || TufError::Missing { what: path.clone() };
        let bytes = client.file(&path, target.length)?.ok_or_else(missing)?;
        target.check(manifest::TARGET, &bytes)?;
        let manifest = Manifest::parse(&bytes)?;
        Ok(Self { manifest_hash: Hash32::of(&bytes), bytes, manifest })
    }

    pub fn text_model(&self) -> impl Iterator<Item = Hash32> + '_ {
        let models = self.manifest.encoder.text_model.iter();
        models.flat_map(TextModelRecord::objects).map(|object| object.hash)
    }

    /// Refuses a manifest of another scene than the accepted one.
    pub fn check(&self, scene: Option<&str>) -> Result<(), FetchError> {
        let offered = &self.manifest.scene;
        match scene.filter(|expected| expected != offered) {
            Some(expected) => Err(FetchError::Request(format!(
                "the store offers scene {offered:?}, this robot expects {expected:?}; check the address, or change the robot's scene once with `slag-edge fetch --scene {offered:?}`"
            ))),
            None => Ok(()),
        }
    }
}

struct StoreMetadata<'a> {
    client: &'a Client<'a>,
    failure: Option<FetchError>,
}

impl Source for StoreMetadata<'_> {
    fn metadata(&mut self, name: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, String> {
        let path = format!("metadata/{name}");
        let is_root = name.ends_with(".root.json");
        let file = if is_root { Client::next_root } else { Client::file };
        file(self.client, &path, max_bytes).map_err(|failure| {
            let what = failure.to_string();
            self.failure = Some(failure);
            what
        })
    }
}
