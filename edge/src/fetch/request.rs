//! Parameters of a fetch.

use slag_common::Hash32;
use slag_common::shard::Profile;

use super::position::Position;

/// Default radius, world units.
pub const DEFAULT_RADIUS: f64 = 50.0;
/// Default number of parallel downloads.
pub const DEFAULT_PARALLEL: usize = 4;

/// Parameters of a fetch.
#[derive(Clone, Debug)]
pub struct FetchRequest {
    /// Address of the store (`http://` or `https://`); absent: that of the last fetch.
    pub from: Option<String>,
    /// Position of the robot; absent: that of the last fetch.
    pub at: Option<Position>,
    /// Cells within this distance are fetched, world units.
    pub radius: f64,
    /// Profile of the shards.
    pub profile: Profile,
    /// At the first contact, trust the root that the store offers.
    pub trust_first: bool,
    /// The only scene accepted, from now on; absent: the one accepted before or, at the first contact, the
    /// server's.
    pub scene: Option<String>,
    /// The only encoder accepted; absent: any.
    pub expected_encoder: Option<Hash32>,
    /// Byte budget for shards; absent: twice the length of the needed ones.
    pub max_bytes: Option<u64>,
    /// Parallel downloads.
    pub parallel: usize,
    /// Use the manifest and shards on board only.
    pub offline: bool,
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
            expected_encoder: None,
            max_bytes: None,
            parallel: DEFAULT_PARALLEL,
            offline: false,
        }
    }
}
