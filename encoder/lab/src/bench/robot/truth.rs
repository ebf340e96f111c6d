//! The oracle: float64 products of all vectors with some queries.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use rayon::prelude::*;

/// Vectors that are read at a time.
const BLOCK: usize = 1 << 14;
/// Scores this close to the last of the best count as ties: the products of others are of f32.
const TIE: f64 = 1e-6;

/// The scores of all vectors for some queries.
pub(super) struct Truth {
    /// `[n_queries][n]`.
    scores: Vec<Vec<f64>>,
}

impl Truth {
    /// Reads `vectors.f32` and the first `n_queries` of `queries.f32`, `[n][dim]` each and little-endian.
    pub(super) fn read(dump: &Path, dim: usize, n_queries: usize) -> std::io::Result<Self> {
        let floats = |bytes: &[u8]| -> Vec<f64> {
            bytes.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]]))).collect()
        };
        let queries = floats(&fs_err::read(dump.join("queries.f32"))?);
        let queries: Vec<&[f64]> = queries.chunks_exact(dim).take(n_queries).collect();
        let mut file = File::open(dump.join("vectors.f32"))?;
        let mut scores = vec![Vec::new(); queries.len()];
        loop {
            let mut bytes = Vec::with_capacity(BLOCK * dim * 4);
            file.by_ref().take((BLOCK * dim * 4) as u64).read_to_end(&mut bytes)?;
            if bytes.is_empty() {
                return Ok(Self { scores });
            }
            let block: Vec<f64> = floats(&bytes);
            scores.par_iter_mut().zip(&queries).for_each(|(scores, query)| {
                scores.extend(block.chunks_exact(dim).map(|vector| slag_math::dot_f64(vector, query)));
            });
        }
    }

    /// Returns the share of a query's best `limit` vectors that was found; `None` for a query without scores.
    pub(super) fn recall(&self, query: usize, limit: usize, found: &[u32]) -> Option<f64> {
        let scores = self.scores.get(query).filter(|scores| !scores.is_empty())?;
        let limit = limit.min(scores.len());
        let mut sorted = scores.clone();
        let (_, last, _) = sorted.select_nth_unstable_by(limit.checked_sub(1)?, |a, b| b.total_cmp(a));
        let reached = *last - TIE;
        let mut found = found.to_vec();
        found.sort_unstable();
        found.dedup();
        let is_best = |id: &&u32| scores.get(**id as usize).is_some_and(|score| *score >= reached);
        Some(found.iter().filter(is_best).count().min(limit) as f64 / limit as f64)
    }
}
