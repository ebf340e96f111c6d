//! A labelled scan of ScanNet v2 (Dai et al. 2017), from its release's files.
//!
//! ```text
//! SCAN/NAME_vh_clean_2.labels.ply               vertices x y z label (NYU40); or, with the table of categories:
//! SCAN/NAME_vh_clean_2.ply                      vertices x y z
//! SCAN/NAME_vh_clean_2.0.010000.segs.json       segIndices: the segment of each vertex
//! SCAN/NAME.aggregation.json                    segGroups [{label, segments}]
//! scannetv2-labels.combined.tsv                 raw_category ... nyu40id
//! ```

use std::collections::{BTreeMap, HashMap};
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
    /// Labels that the table of categories lacks, with their vertices, which count as unlabelled.
    pub(super) unknown_labels: BTreeMap<String, usize>,
}

#[derive(Deserialize)]
struct Segments {
    #[serde(rename = "segIndices")]
    of_vertex: Vec<u32>,
}

#[derive(Deserialize)]
struct Aggregation {
    #[serde(rename = "segGroups")]
    groups: Vec<Group>,
}

#[derive(Deserialize)]
struct Group {
    label: String,
    segments: Vec<u32>,
}

impl Scan {
    /// Reads a scan. `categories` is the data set's table; it is needed where there is no labelled mesh.
    pub(super) fn read(dir: &Path, categories: Option<&Path>) -> Result<Self> {
        let name = dir.canonicalize()?.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let path = dir.join(format!("{name}_vh_clean_2.labels.ply"));
        if !path.is_file() {
            let Some(categories) = categories else {
                bail!(
                    "{} does not exist; add it, or give scannetv2-labels.combined.tsv with --categories",
                    path.display()
                );
            };
            return Self::of_segments(dir, name, categories);
        }
        let rows = read_vertices(&path, ["x", "y", "z", "label"])?;
        if let Some(row) = rows.iter().find(|row| !(0.0..=f64::from(MAX_ID)).contains(&row[3])) {
            let label = row[3];
            bail!(
                "{}: label {label}, expected 0 to {MAX_ID} (NYU40); use the file of the v2 release",
                path.display()
            );
        }
        let (vertices, labels) = rows.iter().map(|[x, y, z, label]| ([*x, *y, *z], *label as u16)).unzip();
        Ok(Self { name, dir: dir.to_owned(), vertices, labels, unknown_labels: BTreeMap::new() })
    }

    /// Returns the segment of each vertex (`[N]`, numbers of the file) by ScanNet's Segmentator.
    pub(super) fn segments(&self) -> Result<Vec<u32>> {
        read_segments(&segments_path(&self.dir, &self.name), self.vertices.len())
    }

    fn of_segments(dir: &Path, name: String, categories: &Path) -> Result<Self> {
        let id_of = read_categories(categories)?;
        let vertices = read_vertices(&dir.join(format!("{name}_vh_clean_2.ply")), ["x", "y", "z"])?;
        let segments = read_segments(&segments_path(dir, &name), vertices.len())?;
        let path =
            [".aggregation.json", "_vh_clean.aggregation.json"].map(|end| dir.join(format!("{name}{end}")));
        let path = path.iter().find(|path| path.is_file()).unwrap_or(&path[0]);
        let expected = || format!("{}: expected segGroups, each with label and segments", path.display());
        let aggregation: Aggregation = serde_json::from_slice(&fs_err::read(path)?).with_context(expected)?;
        let mut id_of_segment: HashMap<u32, u16> = HashMap::new();
        let mut unknown: HashMap<u32, &str> = HashMap::new();
        for group in &aggregation.groups {
            for segment in &group.segments {
                match id_of.get(&group.label) {
                    Some(id) => drop(id_of_segment.insert(*segment, *id)),
                    None => drop(unknown.insert(*segment, &group.label)),
                }
            }
        }
        let mut unknown_labels: BTreeMap<String, usize> = BTreeMap::new();
        for segment in &segments {
            if let Some(label) = unknown.get(segment) {
                *unknown_labels.entry((*label).to_owned()).or_default() += 1;
            }
        }
        let labels = segments.iter().map(|s| id_of_segment.get(s).copied().unwrap_or(0)).collect();
        Ok(Self { name, dir: dir.to_owned(), vertices, labels, unknown_labels })
    }
}

fn segments_path(dir: &Path, name: &str) -> PathBuf {
    dir.join(format!("{name}_vh_clean_2.0.010000.segs.json"))
}

fn read_segments(path: &Path, n_vertices: usize) -> Result<Vec<u32>> {
    let expected = || format!("{}: expected segIndices, one per vertex", path.display());
    let segments: Segments = serde_json::from_slice(&fs_err::read(path)?).with_context(expected)?;
    let n = segments.of_vertex.len();
    if n != n_vertices {
        bail!(
            "{}: {n} segments, expected one for each of {n_vertices} vertices; use both files of one release",
            path.display()
        );
    }
    Ok(segments.of_vertex)
}

/// Reads the NYU40 id of each of the annotators' categories.
fn read_categories(path: &Path) -> Result<HashMap<String, u16>> {
    let text = fs_err::read_to_string(path)?;
    let mut lines = text.lines();
    let head: Vec<&str> = lines.next().unwrap_or_default().split('\t').collect();
    let column = |name: &str| head.iter().position(|found| *found == name);
    let (Some(raw), Some(id)) = (column("raw_category"), column("nyu40id")) else {
        bail!("{}: no columns raw_category and nyu40id; give scannetv2-labels.combined.tsv", path.display());
    };
    let row = |line: &str| {
        let cells: Vec<&str> = line.split('\t').collect();
        let id = cells.get(id)?.parse().ok().filter(|id| *id <= MAX_ID)?;
        Some(((*cells.get(raw)?).to_owned(), id))
    };
    Ok(lines.filter_map(row).collect())
}
