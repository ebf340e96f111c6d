//! Target and pace of a push.

use std::fmt;
use std::num::NonZeroUsize;
use std::time::Duration;

use super::index::IndexSettings;
use super::layout::Layout;

/// Target and pace of a push.
#[derive(Clone)]
pub struct PushOptions {
    /// gRPC address of the database, such as `http://127.0.0.1:6334`.
    pub url: String,
    /// The collection, or the beginning of the names of one a cell; created if absent.
    pub collection: String,
    /// Which collections the scene is pushed to.
    pub layout: Layout,
    /// Settings of the collections.
    pub index: IndexSettings,
    /// Whether each collection has a snapshot at the end.
    pub snapshots: bool,
    /// Key sent with every request.
    pub api_key: Option<String>,
    /// Points in one request.
    pub n_points_per_batch: NonZeroUsize,
    /// Attempts after the first, for transient errors.
    pub n_retries: u32,
    /// Pause before the second attempt; it doubles with each.
    pub retry_delay: Duration,
    /// Time limit of one request.
    pub timeout: Duration,
    /// Time limit of a request for a snapshot.
    pub snapshot_timeout: Duration,
}

impl PushOptions {
    /// Returns options with 256 points a batch (half a megabyte at 512 components) and eight retries
    /// over about a minute.
    pub fn new(url: impl Into<String>, collection: impl Into<String>) -> Self {
        Self {
            url: url.into(),
            collection: collection.into(),
            layout: Layout::One,
            index: IndexSettings::default(),
            snapshots: false,
            api_key: None,
            n_points_per_batch: const { NonZeroUsize::new(256).expect("not zero") },
            n_retries: 8,
            retry_delay: Duration::from_millis(250),
            timeout: Duration::from_secs(60),
            snapshot_timeout: Duration::from_secs(3600),
        }
    }
}

impl fmt::Debug for PushOptions {
    /// Leaves the key out: options end up in logs.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let api_key = self.api_key.as_ref().map(|_| "hidden");
        f.debug_struct("PushOptions")
            .field("url", &self.url)
            .field("collection", &self.collection)
            .field("layout", &self.layout)
            .field("index", &self.index)
            .field("snapshots", &self.snapshots)
            .field("api_key", &api_key)
            .finish_non_exhaustive()
    }
}
