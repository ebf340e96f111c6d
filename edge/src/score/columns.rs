//! Large answers as columns.

use rayon::prelude::*;
use slag_common::shard::ShardView;

use super::matches::{Hit, Run};

/// Gaussians that one thread fills in at a time; small in tests, so that several threads take part.
const CHUNK: usize = if cfg!(test) { 64 } else { 4096 };

/// Gaussians of an answer as columns of equal length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Columns {
    /// Index of the shard in the searched slice.
    pub shard: Vec<u32>,
    pub index: Vec<u32>,
    pub score: Vec<f32>,
    /// Mean, world units.
    pub x: Vec<f64>,
    /// Mean, world units.
    pub y: Vec<f64>,
    /// Mean, world units.
    pub z: Vec<f64>,
}

/// The same rows of all columns.
struct Part<'a> {
    shard: &'a mut [u32],
    index: &'a mut [u32],
    score: &'a mut [f32],
    x: &'a mut [f64],
    y: &'a mut [f64],
    z: &'a mut [f64],
}

impl Part<'_> {
    #[inline]
    fn set(&mut self, at: usize, shards: &[ShardView<'_>], hit: Hit) {
        (self.shard[at], self.index[at], self.score[at]) = (hit.shard, hit.index, hit.score);
        [self.x[at], self.y[at], self.z[at]] =
            shards[hit.shard as usize].position_in_world(hit.index as usize).to_array();
    }
}

impl Columns {
    pub fn len(&self) -> usize {
        self.index.len()
    }

    pub fn is_empty(&self) -> bool {
        self.index.is_empty()
    }

    /// Replaces the columns by an answer of [`super::Search::best`], in its order.
    pub fn set_hits(&mut self, shards: &[ShardView<'_>], hits: &[Hit]) {
        self.resize(hits.len());
        self.parts().zip(hits.par_chunks(CHUNK)).for_each(|(mut part, hits)| {
            hits.iter().enumerate().for_each(|(at, hit)| part.set(at, shards, *hit));
        });
    }

    /// Replaces the columns by an answer of [`super::Search::matching`], in its order.
    pub fn set_runs(&mut self, shards: &[ShardView<'_>], runs: &[Run]) {
        let mut n = 0usize;
        // Where each chunk of rows starts: a run, and a member of it.
        let mut starts = Vec::new();
        for (place, run) in runs.iter().enumerate() {
            let len = (run.end - run.start) as usize;
            while starts.len() * CHUNK < n + len {
                starts.push((place, run.start + (starts.len() * CHUNK - n) as u32));
            }
            n += len;
        }
        self.resize(n);
        self.parts().zip(&starts).for_each(|(mut part, (place, first))| {
            let (mut at, mut start) = (0, *first);
            for (place, run) in runs.iter().enumerate().skip(*place) {
                let end = run.end.min(start + (part.index.len() - at) as u32);
                for index in start..end {
                    part.set(at, shards, Hit { shard: run.shard, index, score: run.score });
                    at += 1;
                }
                let Some(next) = runs.get(place + 1).filter(|_| at < part.index.len()) else { return };
                start = next.start;
            }
        });
    }

    fn resize(&mut self, len: usize) {
        [&mut self.shard, &mut self.index].into_iter().for_each(|column| column.resize(len, 0));
        [&mut self.x, &mut self.y, &mut self.z].into_iter().for_each(|column| column.resize(len, 0.0));
        self.score.resize(len, 0.0);
    }

    fn parts(&mut self) -> impl IndexedParallelIterator<Item = Part<'_>> {
        let ids = self.shard.par_chunks_mut(CHUNK).zip(self.index.par_chunks_mut(CHUNK));
        let plane = self.x.par_chunks_mut(CHUNK).zip(self.y.par_chunks_mut(CHUNK));
        let rest = self.score.par_chunks_mut(CHUNK).zip(self.z.par_chunks_mut(CHUNK));
        let all = ids.zip(plane).zip(rest);
        all.map(|(((shard, index), (x, y)), (score, z))| Part { shard, index, score, x, y, z })
    }
}
