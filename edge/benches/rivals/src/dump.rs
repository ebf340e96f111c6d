//! The vectors and queries of a comparison.

use std::fs::File;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use memmap2::Mmap;
use serde::{Deserialize, Serialize};

#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Meta {
    pub n: usize,
    pub dim: usize,
    pub n_queries: usize,
}

/// A dump on disk, unit vectors: little-endian `vectors.f32` `[n][dim]`, `queries.f32` `[n_queries][dim]`,
/// `meta.json`.
pub struct Dump {
    pub meta: Meta,
    vectors: Mmap,
    queries: Vec<f32>,
}

impl Dump {
    /// Opens a dump; its vectors stay on disk.
    pub fn open(dir: &Path) -> Result<Self> {
        let named = |name: &str| {
            let path = dir.join(name);
            File::open(&path).with_context(|| format!("{} cannot be read", path.display())).map(|f| (f, path))
        };
        let (file, path) = named("meta.json")?;
        let meta: Meta = serde_json::from_reader(file).with_context(|| path.display().to_string())?;
        ensure!(
            meta.n > 0 && meta.dim > 0 && meta.n_queries > 0,
            "{}: nothing to compare: {meta:?}",
            path.display()
        );
        let mapped = |name: &str, n: usize| -> Result<Mmap> {
            let (file, path) = named(name)?;
            // SAFETY: only this benchmark's own run uses the file, and nothing writes to it.
            let bytes = unsafe { Mmap::map(&file) }.with_context(|| path.display().to_string())?;
            let expected = n.checked_mul(meta.dim).and_then(|n| n.checked_mul(4));
            ensure!(
                Some(bytes.len()) == expected,
                "{} has {} bytes, meta.json says [{n}][{}]",
                path.display(),
                bytes.len(),
                meta.dim
            );
            Ok(bytes)
        };
        let queries = mapped("queries.f32", meta.n_queries)?;
        Ok(Self {
            meta,
            vectors: mapped("vectors.f32", meta.n)?,
            queries: bytemuck::cast_slice(&queries).to_vec(),
        })
    }

    /// Returns all vectors, `[n][dim]`.
    pub fn vectors(&self) -> &[f32] {
        bytemuck::cast_slice(&self.vectors)
    }

    /// Drops the vectors, so that only an index has them, and returns the queries.
    pub fn into_queries(self) -> Vec<Vec<f32>> {
        self.queries.chunks_exact(self.meta.dim).map(<[f32]>::to_vec).collect()
    }
}
