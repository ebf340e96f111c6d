//! Rereads shards on board, one at a time, and marks rotten ones.

use std::collections::BTreeMap;
use std::io;

use slag_common::Hash32;

use super::cache::EdgeCache;
use super::snapshot::Snapshot;

#[derive(Debug, Default)]
pub struct Scrubber {
    read: BTreeMap<Hash32, u64>,
    n_steps: u64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scrubbed {
    pub cell_id: u32,
    /// Its share of all bytes on board, above 0 up to 1.
    pub share: f64,
    /// Whether the hash matches; otherwise it is marked.
    pub is_sound: bool,
}

impl Scrubber {
    /// Reads the shard of a generation that was read longest ago; `None` if it has none. Takes the shard's length in
    /// memory: an unreadable sector is an error of `read`, but would end a program that maps it.
    pub fn step(&mut self, cache: &EdgeCache, snapshot: &Snapshot) -> Option<Scrubbed> {
        let hashes = || snapshot.shards.iter().map(|shard| (shard.hash(), shard));
        let n_before = self.read.len();
        if n_before > snapshot.shards.len() {
            let on_board: BTreeMap<_, _> = hashes().collect();
            self.read.retain(|hash, _| on_board.contains_key(&Some(*hash)));
        }
        let last_read = |hash: Option<Hash32>| hash.and_then(|hash| self.read.get(&hash).copied());
        let (hash, shard) = hashes().min_by_key(|(hash, _)| last_read(*hash))?;
        let (hash, len_bytes) = (hash?, shard.len_bytes());
        let read = cache.files().read(&cache.shard_path(hash), len_bytes);
        let is_sound = match &read {
            Ok(bytes) => Hash32::of(bytes) == hash,
            // A fetch removed it; the snapshot still has it open.
            Err(e) => e.kind() == io::ErrorKind::NotFound,
        };
        self.n_steps += 1;
        match is_sound {
            true => drop(self.read.insert(hash, self.n_steps)),
            // Read again at once if still in use.
            false => {
                let error =
                    read.err().map_or_else(|| "its bytes have another hash".to_owned(), |e| e.to_string());
                tracing::warn!("the shard of cell {} rotted: {error}", shard.cell.cell_id);
                cache.mark_damaged(hash);
            }
        }
        let all_bytes: u64 = snapshot.shards.iter().map(|shard| shard.len_bytes()).sum();
        let share = len_bytes as f64 / all_bytes.max(1) as f64;
        Some(Scrubbed { cell_id: shard.cell.cell_id, share, is_sound })
    }
}
