//! The text model that a scene brings along.

use std::path::PathBuf;

use slag_common::Hash32;
use slag_common::manifest::{Manifest, TextModelRecord};
use slag_models::{ModelDir, SessionOptions};

use crate::store::{EdgeCache, StoreError, damaged};
use crate::text::{TextOpenError, TextService};

/// Longest description read; those of public models take two thousand bytes.
const MAX_DESCRIPTION_BYTES: u64 = 1 << 20;

/// Reasons for which a scene's text model does not open.
#[derive(Debug, thiserror::Error)]
pub enum CarriedError {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("{path}: {cause}; fetch again, which replaces what is damaged", path = path.display())]
    Open { path: PathBuf, cause: Box<TextOpenError> },
}

/// Opens the text model that a scene carries; `None` if it carries none.
pub(super) fn open(
    cache: &EdgeCache,
    manifest: &Manifest,
    options: &SessionOptions,
) -> Result<Option<TextService>, CarriedError> {
    let Some(record) = &manifest.encoder.text_model else { return Ok(None) };
    let expected = record.description.hash;
    let path = cache.shard_path(expected);
    let mark = || mark_damaged(cache, record);
    let read = cache.files().read(&path, MAX_DESCRIPTION_BYTES).map_err(StoreError::from);
    let bytes = read.inspect_err(|e| {
        if e.is_damage() {
            mark()
        }
    })?;
    let found = Hash32::of(&bytes);
    if found != expected {
        mark();
        return Err(StoreError::Hash { path, expected, found }.into());
    }
    let folder = path.parent().unwrap_or(cache.dir());
    let opened = ModelDir::carried(&bytes, &path, folder)
        .map_err(TextOpenError::Model)
        .and_then(|models| TextService::open(&models, options));
    opened.map(Some).map_err(|cause| {
        if matches!(cause, TextOpenError::Model(_)) {
            mark();
        }
        CarriedError::Open { path, cause: Box::new(cause) }
    })
}

/// Marks the files that are not as listed; the next fetch downloads them again.
fn mark_damaged(cache: &EdgeCache, record: &TextModelRecord) {
    for object in record.objects() {
        let read = cache.files().read(&cache.shard_path(object.hash), object.len_bytes);
        if !read.is_ok_and(|bytes| Hash32::of(&bytes) == object.hash) {
            damaged::mark(cache, object.hash);
        }
    }
}
