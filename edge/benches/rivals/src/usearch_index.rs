//! usearch: an HNSW graph and its vectors in memory, in one file on disk.

use std::path::Path;

use anyhow::{Context, Result};
use rayon::prelude::*;
use usearch::{IndexOptions, MetricKind, ScalarKind};

use crate::dump::Dump;
use crate::{Engine, Index};

/// An index in memory.
pub struct Usearch(usearch::Index);

impl Usearch {
    pub fn build(dump: &Dump, work: &Path, engine: Engine) -> Result<Self> {
        let dim = dump.meta.dim;
        let options = IndexOptions {
            dimensions: dim,
            metric: MetricKind::IP,
            quantization: if engine == Engine::UsearchHnswInt8 { ScalarKind::I8 } else { ScalarKind::F32 },
            connectivity: crate::graph::EDGES,
            expansion_add: crate::graph::CANDIDATES,
            expansion_search: 0,
            multi: false,
        };
        let index = usearch::Index::new(&options)?;
        index.reserve_capacity_and_threads(dump.meta.n, rayon::current_num_threads())?;
        let add = |(id, vector): (usize, &[f32])| index.add(id as u64, vector);
        dump.vectors().par_chunks_exact(dim).enumerate().try_for_each(add)?;
        let path = work.join("index.usearch");
        index.save(path.to_str().context("the work folder's name is no UTF-8")?)?;
        Ok(Self(index))
    }
}

impl Index for Usearch {
    fn search(&self, query: &[f32], limit: usize) -> Result<Vec<u32>> {
        let found = self.0.search(query, limit)?;
        found.keys.into_iter().map(|key| Ok(u32::try_from(key)?)).collect()
    }
}
