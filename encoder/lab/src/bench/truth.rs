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

    /// Returns the mean recall of the queries whose ids were written, as `NAME-LIMIT-QUERY.u32`.
    pub(super) fn mean_recall(&self, name: &str, limit: u64, ids: &Path) -> std::io::Result<Option<f64>> {
        let mut recalls = Vec::new();
        for query in 0..self.scores.len() {
            let path = ids.join(format!("{name}-{limit}-{query}.u32"));
            if path.is_file() {
                let bytes = fs_err::read(path)?;
                let found = bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
                recalls.extend(self.recall(query, limit as usize, found.collect()));
            }
        }
        Ok((!recalls.is_empty()).then(|| recalls.iter().sum::<f64>() / recalls.len() as f64))
    }

    /// Returns the share of a query's best `limit` vectors that was found; `None` for a query without scores.
    fn recall(&self, query: usize, limit: usize, mut found: Vec<u32>) -> Option<f64> {
        let scores = self.scores.get(query).filter(|scores| !scores.is_empty())?;
        let limit = limit.min(scores.len());
        let mut sorted = scores.clone();
        let (_, last, _) = sorted.select_nth_unstable_by(limit.checked_sub(1)?, |a, b| b.total_cmp(a));
        let reached = *last - TIE;
        found.sort_unstable();
        found.dedup();
        let is_best = |id: &&u32| scores.get(**id as usize).is_some_and(|score| *score >= reached);
        Some(found.iter().filter(is_best).count().min(limit) as f64 / limit as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: scores 1, 0.5, 0.5, 0 and -1; the second and third are ties.
    #[test]
    fn recall_counts_ties_and_each_id_once() {
        let dir = tempfile::tempdir().expect("a folder");
        let write = |name: &str, values: &[f32]| {
            let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            fs_err::write(dir.path().join(name), bytes).expect("writes");
        };
        write("vectors.f32", &[0.5, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.5, 0.8]);
        write("queries.f32", &[1.0, 0.0, 0.0, 1.0]);
        let truth = Truth::read(dir.path(), 2, 1).expect("reads");
        for (limit, found, expected) in [
            (1, vec![2], 1.0),
            (2, vec![2, 4], 1.0),
            (2, vec![2, 0], 1.0),
            (3, vec![2, 4, 3], 2.0 / 3.0),
            (3, vec![2, 2, 2], 1.0 / 3.0),
            (9, vec![0, 1, 2, 3, 4], 1.0),
            (2, vec![77], 0.0),
        ] {
            assert_eq!(truth.recall(0, limit, found.clone()), Some(expected), "{limit} {found:?}");
        }
        assert_eq!(truth.recall(1, 2, vec![0]), None, "one query was read");
    }
}
