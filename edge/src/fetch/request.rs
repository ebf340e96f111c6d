//! A fetch's request and environment: clock, cancel flag, random numbers, progress and network limits.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use glam::DVec3;
use serde::Serialize;
use slag_common::Hash32;
use slag_common::shard::Profile;
use slag_models::download::{DownloadFailure, NetworkLimits};

use super::position::Position;
use crate::store::BadCell;

/// World units.
pub const DEFAULT_RADIUS: f64 = 50.0;
const DEFAULT_PARALLEL: usize = 4;

#[derive(Clone, Debug)]
pub struct FetchRequest {
    /// Address of the store (`http://` or `https://`); absent: that of the last fetch.
    pub from: Option<String>,
    /// Position of the robot; absent: that of the last fetch.
    pub at: Option<Position>,
    /// Cells within this distance are fetched, world units.
    pub radius: f64,
    pub profile: Profile,
    pub trust_first: bool,
    /// The only scene accepted from now on; absent: the one accepted before or, at first contact, the server's.
    pub scene: Option<String>,
    /// Byte budget for shards; absent: twice the length of the needed ones.
    pub max_bytes: Option<u64>,
    pub parallel: usize,
}

impl Default for FetchRequest {
    fn default() -> Self {
        Self {
            from: None,
            at: None,
            radius: DEFAULT_RADIUS,
            profile: Profile::Compact,
            trust_first: false,
            scene: None,
            max_bytes: None,
            parallel: DEFAULT_PARALLEL,
        }
    }
}

pub trait Progress: Sync {
    /// Called once with the length of the shards to download.
    fn planned(&self, _bytes: u64) {}
    /// Called with the number of bytes received since the last call.
    fn received(&self, _bytes: u64) {}
    /// Called when an attempt failed and another follows.
    fn retried(&self, _url: &str, _failure: &DownloadFailure) {}
}

impl Progress for () {}

pub struct Environment<'a> {
    pub now_unix_secs: u64,
    /// Set to end the fetch; the next one resumes.
    pub cancel: &'a AtomicBool,
    pub progress: &'a dyn Progress,
    /// Returns numbers within 0..1, to spread retries.
    pub random: &'a (dyn Fn() -> f64 + Sync),
    /// PEM certificates of the authorities for `https://` addresses; absent: those of browsers.
    pub ca: Option<&'a Path>,
    pub limits: NetworkLimits,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Tally {
    pub n_shards: usize,
    pub bytes: u64,
}

impl Tally {
    pub(super) fn of(lengths: impl Iterator<Item = u64>) -> Self {
        lengths.fold(Self::default(), |sum, len| Self {
            n_shards: sum.n_shards + 1,
            bytes: sum.bytes.saturating_add(len),
        })
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct TextModelTally {
    pub bytes: u64,
    pub downloaded_bytes: u64,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FetchReport {
    pub scene: String,
    pub generation: u64,
    /// BLAKE3 of the manifest.
    pub manifest_hash: Hash32,
    pub root_version: u64,
    /// Whether that root was accepted because it was the first.
    pub is_first_contact: bool,
    /// The encoder whose text model answers queries.
    pub encoder_id: Hash32,
    pub encoder_name: String,
    pub profile: Profile,
    pub centre_in_world: DVec3,
    /// Radius, world units.
    pub radius: f64,
    pub n_cells: usize,
    /// Those whose shard could not be fetched.
    pub bad_cells: Vec<BadCell>,
    pub downloaded: Tally,
    /// Needed shards that were on board already.
    pub kept: Tally,
    /// Shards on board that are not needed but fit the budget.
    pub spare: Tally,
    pub freed: Tally,
    /// The text model, if the scene carries one; not counted among the shards.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub text_model: Option<TextModelTally>,
    /// Bytes of the downloaded objects left by an interrupted fetch.
    pub resumed_bytes: u64,
    /// Attempts beyond the first.
    pub retries: u64,
    pub seconds: f64,
}
