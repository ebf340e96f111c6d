//! A shard on board: mapped, and checked against the manifest.

use std::path::Path;

use slag_common::Hash32;
use slag_common::manifest::{CellRecord, Manifest};
use slag_common::shard::{Additions, Profile, ShardLayout, ShardView};

use super::cache::{CurrentCell, EdgeCache, cell_of};
use super::error::StoreError;
use super::files::Stat;
use super::mmap::FileBytes;

#[derive(Debug)]
pub struct OpenShard {
    pub cell: CellRecord,
    layout: ShardLayout,
    bytes: FileBytes,
    profile: Profile,
    /// State of the file just before it was mapped.
    stat: Option<Stat>,
}

impl OpenShard {
    pub fn view(&self) -> ShardView<'_> {
        self.layout.view(&self.bytes)
    }

    pub fn additions(&self) -> Additions<'_> {
        self.layout.additions(&self.bytes)
    }

    pub fn hash(&self) -> Option<Hash32> {
        self.cell.shards.get(&self.profile).map(|shard| shard.hash)
    }

    pub fn len_bytes(&self) -> u64 {
        self.bytes.len() as u64
    }

    /// Returns whether this is the listed shard, and still the file on board.
    pub(super) fn is(&self, cache: &EdgeCache, listed: &Listed<'_>) -> bool {
        let Listed { manifest, profile, at } = *listed;
        let header = self.view().header;
        let is_listed = cell_of(manifest, at.cell_id) == Some(&self.cell) && self.profile == profile;
        let is_named = self.hash() == Some(at.hash);
        let is_readable = (header.dim, header.encoder_id) == (manifest.encoder.dim, manifest.encoder.id.0);
        // Without timestamps, storage cannot show that a file was replaced.
        let is_unchanged = self.stat.is_some_and(|stat| stat.modified.is_some())
            && cache.files().stat(&cache.shard_path(at.hash)).is_ok_and(|stat| stat == self.stat);
        is_listed && is_named && is_readable && is_unchanged
    }
}

/// A cell's shard as `current` names it and a manifest describes it.
#[derive(Clone, Copy)]
pub struct Listed<'a> {
    pub manifest: &'a Manifest,
    pub profile: Profile,
    pub at: &'a CurrentCell,
}

impl<'a> Listed<'a> {
    /// Checks a shard of the cache with ordinary reads, then maps it.
    pub fn open(&self, cache: &EdgeCache) -> Result<OpenShard, StoreError> {
        let path = cache.shard_path(self.at.hash);
        let stat = cache.files().stat(&path)?;
        let (cell, layout) = self.check_file(cache)?;
        // A fetch may remove it in between.
        let bytes = cache.files().map(&path).map_err(StoreError::missing(&path))?;
        if bytes.len() as u64 != self.at.len_bytes {
            return Err(StoreError::Missing { path });
        }
        Ok(OpenShard { cell: cell.clone(), layout, bytes, profile: self.profile, stat })
    }

    /// Reads its file and checks it. Not through a map, where an unreadable page ends the program.
    pub fn check_file(&self, cache: &EdgeCache) -> Result<(&'a CellRecord, ShardLayout), StoreError> {
        let path = cache.shard_path(self.at.hash);
        let bytes = cache.files().read(&path, self.at.len_bytes).map_err(StoreError::missing(&path))?;
        self.check(&path, &bytes)
    }

    /// Checks that bytes are an intact shard, and this one.
    pub fn check(&self, path: &Path, bytes: &[u8]) -> Result<(&'a CellRecord, ShardLayout), StoreError> {
        let Self { manifest, profile, at } = *self;
        let same = |field, expected: &dyn ToString, found: &dyn ToString| {
            let (expected, found) = (expected.to_string(), found.to_string());
            let what = format!("{field} is {found}, the manifest says {expected}");
            let wrong = || StoreError::Wrong { path: path.to_owned(), what };
            if expected == found { Ok(()) } else { Err(wrong()) }
        };
        let cell = cell_of(manifest, at.cell_id);
        let Some((cell, listed)) = cell.and_then(|cell| Some((cell, cell.shards.get(&profile)?))) else {
            let (cell_id, path) = (at.cell_id, path.to_owned());
            return Err(StoreError::Unlisted { path, cell_id, profile });
        };
        same("the name", &listed.hash, &at.hash)?;
        same("the length in bytes", &listed.len_bytes, &bytes.len())?;
        let layout = ShardLayout::check(bytes)
            .map_err(|source| StoreError::Shard { path: path.to_owned(), source })?;
        let header = layout.header;
        same("the cell", &cell.cell_id, &header.cell_id)?;
        same("the number of Gaussians", &cell.n_gaussians, &header.n_gaussians)?;
        same("the embedding dimension", &manifest.encoder.dim, &header.dim)?;
        same("the encoder", &manifest.encoder.id, &Hash32(header.encoder_id))?;
        Ok((cell, layout))
    }
}
