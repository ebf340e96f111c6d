//! Writes a cache's vectors and search results as plain files, for comparison with other engines.

use std::io::{self, BufWriter, Write};
use std::path::Path;

use rayon::prelude::*;
use serde_json::json;
use slag_common::shard::ShardView;

use super::vectors::normalise;
use crate::score::{Precision, Question, Region, ScoreError, Search};

/// Gaussians that are decoded at a time.
const CHUNK: usize = 4096;

/// Reasons for which a dump fails.
#[derive(Debug, thiserror::Error)]
pub enum DumpError {
    /// The file system's error, with the path.
    #[error("{0}; choose a folder with enough space for the vectors")]
    Io(#[from] io::Error),
    /// The queries have another dimension.
    #[error(transparent)]
    Score(#[from] ScoreError),
}

/// Writes `vectors.f32` (`[n][dim]`: all Gaussians with an embedding, shard by shard, decoded, unit length),
/// `queries.f32` (`[n_queries][dim]`) and `meta.json` to a folder; floats are little-endian.
///
/// # Errors
/// [`DumpError`].
pub fn dump_vectors(dir: &Path, shards: &[ShardView<'_>], queries: &[Vec<f32>]) -> Result<(), DumpError> {
    fs_err::create_dir_all(dir)?;
    let dim = shards.first().map_or(0, |shard| shard.header.dim as usize);
    let mut vectors = BufWriter::new(fs_err::File::create(dir.join("vectors.f32"))?);
    let mut n = 0;
    for shard in shards {
        n += shard.n_with_evidence();
        for start in (0..shard.n_with_evidence()).step_by(CHUNK) {
            let end = shard.n_with_evidence().min(start + CHUNK);
            let decode = |index: usize| {
                let mut vector = vec![0.0; dim];
                shard.decode(index, &mut vector);
                normalise(&mut vector);
                vector.into_iter().flat_map(|v| (v as f32).to_le_bytes()).collect::<Vec<u8>>()
            };
            let decoded: Vec<Vec<u8>> = (start..end).into_par_iter().map(decode).collect();
            decoded.iter().try_for_each(|bytes| vectors.write_all(bytes))?;
        }
    }
    vectors.flush()?;
    let queries_bytes: Vec<u8> = queries.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    fs_err::write(dir.join("queries.f32"), queries_bytes)?;
    let meta = json!({ "n": n, "dim": dim, "n_queries": queries.len() });
    fs_err::write(dir.join("meta.json"), meta.to_string())?;
    Ok(())
}

/// Writes the results of each query, best first, as little-endian u32 indices into `vectors.f32`:
/// `NAME-LIMIT-QUERY.u32`.
///
/// # Errors
/// [`DumpError`].
pub fn dump_ids(
    dir: &Path,
    name: &str,
    shards: &[ShardView<'_>],
    queries: &[Vec<f32>],
    limits: &[usize],
    precision: Precision,
) -> Result<(), DumpError> {
    fs_err::create_dir_all(dir)?;
    let mut first = vec![0u32];
    for shard in shards {
        first.push(first[first.len() - 1].saturating_add(shard.n_with_evidence() as u32));
    }
    for (at, query) in queries.iter().enumerate() {
        let question = Question::new(&query[..]);
        let search = Search::new(shards, &question, Region::default(), precision)?;
        for limit in limits {
            let hits = search.best(*limit, f32::NEG_INFINITY, None);
            let ids = hits.iter().flat_map(|hit| (first[hit.shard as usize] + hit.index).to_le_bytes());
            fs_err::write(dir.join(format!("{name}-{limit}-{at}.u32")), ids.collect::<Vec<u8>>())?;
        }
    }
    Ok(())
}
