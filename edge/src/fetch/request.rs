//! What a fetch is asked for.

use slag_common::Hash32;
use slag_common::shard::Profile;

use super::position::Position;

/// Radius unless one is given, world units.
pub const DEFAULT_RADIUS: f64 = 50.0;
/// Downloads at a time unless a number is given.
pub const DEFAULT_PARALLEL: usize = 4;

/// What to fetch.
#[derive(Clone, Debug)]
pub struct FetchRequest {
    /// Address of the store (`http://` or `https://`); absent: that of the last fetch.
    pub from: Option<String>,
    /// Where the robot is; absent: where it was at the last fetch.
    pub at: Option<Position>,
    /// How far cells matter, world units.
    pub radius: f64,
    /// How much each shard carries.
    pub profile: Profile,
    /// The only keys accepted, or those that have taken their places since; empty: the one accepted
    /// before, or, at the first contact, the server's. A key's named successor is accepted with it.
    pub keys: Vec<Hash32>,
    /// The only encoder accepted; absent: any.
    pub expected_encoder: Option<Hash32>,
    /// Bytes that shards may take; absent: twice what the cells within the radius take.
    pub max_bytes: Option<u64>,
    /// Downloads at a time.
    pub parallel: usize,
    /// Plan with the manifest and the shards on board, without network.
    pub offline: bool,
}

impl Default for FetchRequest {
    fn default() -> Self {
        Self {
            from: None,
            at: None,
            radius: DEFAULT_RADIUS,
            profile: Profile::Compact,
            keys: Vec::new(),
            expected_encoder: None,
            max_bytes: None,
            parallel: DEFAULT_PARALLEL,
            offline: false,
        }
    }
}
