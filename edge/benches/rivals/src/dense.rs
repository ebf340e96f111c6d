//! A dense scan: the product of a query with every vector, then the best.

use anyhow::Result;
use rayon::prelude::*;

use crate::Index;
use crate::dump::Dump;

/// Sums formed side by side, so that the compiler uses vector instructions.
const LANES: usize = 16;

pub struct Dense {
    dim: usize,
    vectors: Vec<f32>,
}

impl Dense {
    pub fn new(dump: &Dump) -> Self {
        Self { dim: dump.meta.dim, vectors: dump.vectors().to_vec() }
    }
}

impl Index for Dense {
    fn search(&self, query: &[f32], limit: usize) -> Result<Vec<u32>> {
        let score = |(id, vector): (usize, &[f32])| (dot(query, vector), id as u32);
        let mut scores: Vec<(f32, u32)> =
            self.vectors.par_chunks_exact(self.dim).enumerate().map(score).collect();
        let order = |a: &(f32, u32), b: &(f32, u32)| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1));
        if limit < scores.len() {
            scores.select_nth_unstable_by(limit, order);
            scores.truncate(limit);
        }
        scores.par_sort_unstable_by(order);
        Ok(scores.into_iter().map(|(_, id)| id).collect())
    }
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    let (a, b) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest: f32 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a.zip(b) {
        for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    sums.iter().sum::<f32>() + rest
}
