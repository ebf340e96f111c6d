//! A labelled scan of ScanNet v2 (Dai et al. 2017), from its release's files.
//!
//! ```text
//! SCAN/NAME_vh_clean_2.labels.ply               vertices x y z label (NYU40)
//! SCAN/NAME_vh_clean_2.0.010000.segs.json       segIndices: the segment of each vertex
//! ```

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::Deserialize;
use slag_common::splat::ply::read_vertices;

/// Largest NYU40 id.
const MAX_ID: u16 = 40;

/// A labelled mesh.
#[derive(Clone, Debug)]
pub(super) struct Scan {
    pub(super) name: String,
    pub(super) dir: PathBuf,
    /// The vertices, world frame, metres.
    pub(super) vertices: Vec<[f64; 3]>,
    /// `[N]`: NYU40 id of each, 0 where there is none.
    pub(super) labels: Vec<u16>,
}

#[derive(Deserialize)]
struct Segments {
    #[serde(rename = "segIndices")]
    of_vertex: Vec<u32>,
}

impl Scan {
    pub(super) fn read(dir: &Path) -> Result<Self> {
        let name = dir.canonicalize()?.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let path = dir.join(format!("{name}_vh_clean_2.labels.ply"));
        let rows = read_vertices(&path, ["x", "y", "z", "label"])?;
        if let Some(row) = rows.iter().find(|row| !(0.0..=f64::from(MAX_ID)).contains(&row[3])) {
            let label = row[3];
            bail!(
                "{}: label {label}, expected 0 to {MAX_ID} (NYU40); use the file of the v2 release",
                path.display()
            );
        }
        let (vertices, labels) = rows.iter().map(|[x, y, z, label]| ([*x, *y, *z], *label as u16)).unzip();
        Ok(Self { name, dir: dir.to_owned(), vertices, labels })
    }

    /// Returns the segment of each vertex (`[N]`, numbers of the file) by ScanNet's Segmentator.
    pub(super) fn segments(&self) -> Result<Vec<u32>> {
        let path = self.dir.join(format!("{}_vh_clean_2.0.010000.segs.json", self.name));
        let expected = || format!("{}: expected segIndices, one per vertex", path.display());
        let segments: Segments = serde_json::from_slice(&fs_err::read(&path)?).with_context(expected)?;
        let (n, n_vertices) = (segments.of_vertex.len(), self.vertices.len());
        if n != n_vertices {
            bail!(
                "{}: {n} segments, expected one for each of {n_vertices} vertices; use both files of one release",
                path.display()
            );
        }
        Ok(segments.of_vertex)
    }
}
