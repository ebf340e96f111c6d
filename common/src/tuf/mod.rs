//! The Update Framework: proves which files of a store are genuine, whatever carried them.
//!
//! The client workflow of the TUF specification 1.0 (section 5) without network, clock or files: bytes come from a
//! [`Source`], the time is an argument, and what must be remembered is [`Kept`]. A store is a TUF repository with
//! consistent snapshots; its keys are Ed25519.
//!
//! | role | signs | where its key lives |
//! |---|---|---|
//! | root | the keys of all roles | offline, several with a threshold |
//! | targets | lengths and hashes of the files | where scenes are published |
//! | snapshot | the versions of all targets metadata | where scenes are published |
//! | timestamp | the version of the snapshot, for a short time | where a timer can sign |

mod canonical;
mod error;
mod metadata;
mod repository;
mod signed;
mod time;
mod trusted;
mod update;

pub use error::TufError;
pub use metadata::{
    Body, FileMeta, Key, RoleKeys, Root, Snapshot, TargetFile, Targets, Timestamp, sha256_hex,
};
pub use repository::one_key_repository;
pub use signed::{Envelope, Head, MetadataSignature, SignedMetadata, add_signatures, generate_key, sign};
pub use time::{format_utc, parse_utc};
pub use trusted::{Kept, Offered, Trusted};
pub use update::{Source, refresh};

pub const SPEC_VERSION: &str = "1.0.31";
pub const MAX_ROOT_BYTES: u64 = 256 << 10;
pub const MAX_TIMESTAMP_BYTES: u64 = 16 << 10;
/// Longest snapshot metadata read; bounds what a client keeps (root, timestamp, snapshot).
pub const MAX_SNAPSHOT_BYTES: u64 = 256 << 10;
pub const MAX_TARGETS_BYTES: u64 = 5 << 20;
pub const MAX_ROOTS: u32 = 256;
