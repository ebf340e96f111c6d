//! The objects of a shard: things that the masks of several views agree on. The byte table is in `docs/formats.md`.
//!
//! A shard has the complete record of every object with Gaussians in its cell, so a robot that holds part of the
//! scene knows the size and position of objects that extend beyond it. Objects have sections of their own, which
//! readers that do not know them skip.

mod changes;
mod columns;
mod thumbnails;

pub use changes::{Changes, Moved, Place, Thing, changes, is_unchanged, parse_public_id, public_id};
pub(crate) use columns::check;
pub use columns::{
    MAX_PHOTO_BYTES, MAX_VECTORS, NO_OBJECT, ObjectRecord, Objects, ObjectsHeader, collect_runs,
    object_score, quantise_vectors, section,
};
pub use thumbnails::{MAX_THUMBNAIL_BYTES, Thumbnails};
