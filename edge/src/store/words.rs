//! Vectors of the words for naming, `words/ENCODER`: large text models take a minute for them.
//!
//! A container (`slag_common::container`) of the requested and the known words, a line each, and the latter's
//! vectors, `[n][dim]` f32. If missing or damaged, they are encoded again.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use slag_common::Hash32;
use slag_common::container::{self, Layout};

use super::cache::EdgeCache;
use super::files::put_through;

/// A longer file is ignored: 4,096 words with 2,048 components take less.
const MAX_BYTES: u64 = 64 << 20;
const MAGIC: [u8; 8] = *b"SLAGWORD";
const VERSION: u32 = 1;
const ASKED: u32 = 1;
const KNOWN: u32 = 2;
const VECTORS: u32 = 3;

pub type WordVector = (String, Arc<[f32]>);

fn path(cache: &EdgeCache, encoder_id: Hash32) -> PathBuf {
    cache.dir().join("words").join(encoder_id.to_string())
}

/// Returns the known ones of some words for an encoder; `None` unless kept for exactly these words.
pub fn read(cache: &EdgeCache, encoder_id: Hash32, dim: usize, asked: &[String]) -> Option<Vec<WordVector>> {
    let bytes = cache.files().read(&path(cache, encoder_id), MAX_BYTES).ok()?;
    let layout = Layout::check(&bytes, MAGIC, VERSION).ok()?;
    let text = |id| Some(std::str::from_utf8(&bytes[layout.find(id)?]).ok()?.lines());
    let known: Vec<&str> = text(KNOWN)?.collect();
    if !text(ASKED)?.eq(asked) || dim == 0 {
        return None;
    }
    let vectors = layout.column::<f32>(VECTORS, "vectors", known.len().checked_mul(dim)?).ok()?;
    let vectors: &[f32] = bytemuck::cast_slice(&bytes[vectors]);
    let words = known.into_iter().zip(vectors.chunks_exact(dim));
    Some(words.map(|(word, vector)| (word.to_owned(), vector.into())).collect())
}

/// Keeps the words that an encoder knows, in place of other encoders' words.
pub fn write(
    cache: &EdgeCache,
    encoder_id: Hash32,
    asked: &[String],
    known: &[WordVector],
) -> io::Result<()> {
    let words: Vec<&str> = known.iter().map(|(word, _)| word.as_str()).collect();
    let vectors: Vec<f32> = known.iter().flat_map(|(_, vector)| vector.iter().copied()).collect();
    let (asked, words) = (asked.join("\n"), words.join("\n"));
    let sections =
        [(ASKED, asked.as_bytes()), (KNOWN, words.as_bytes()), (VECTORS, container::bytes_of(&vectors))];
    let mut bytes = Vec::new();
    container::write(&mut bytes, MAGIC, VERSION, &sections)?;
    let (files, path) = (cache.files(), path(cache, encoder_id));
    let dir = path.parent().unwrap_or(cache.dir());
    cache.create_dir(dir)?;
    for old in files.list(dir)? {
        files.remove(&dir.join(old))?;
    }
    put_through(files, &path.with_extension("part"), &bytes, &path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_kept_whole_or_not_at_all() {
        let dir = tempfile::tempdir().expect("a folder");
        let (cache, id) = (EdgeCache::open(dir.path()), Hash32([7; 32]));
        let asked = ["mug", "what it does not know", "red chair"].map(str::to_owned);
        let vector = |x: f32| -> Arc<[f32]> { vec![x, -x].into() };
        let known = vec![(asked[0].clone(), vector(1.0)), (asked[2].clone(), vector(0.5))];
        assert_eq!(read(&cache, id, 2, &asked), None);
        write(&cache, Hash32([6; 32]), &asked, &known).expect("kept");
        write(&cache, id, &asked, &known).expect("kept");
        assert_eq!(read(&cache, id, 2, &asked), Some(known));
        assert_eq!(read(&cache, id, 2, &asked[..2]), None);
        assert_eq!(read(&cache, id, 3, &asked), None);
        assert_eq!(read(&cache, Hash32([6; 32]), 2, &asked), None);
        let path = path(&cache, id);
        let bytes = fs_err::read(&path).expect("there");
        fs_err::write(&path, &bytes[..bytes.len() - 1]).expect("written");
        assert_eq!(read(&cache, id, 2, &asked), None);
    }
}
