//! `bench field`: publishes a store of a generated field, which `slag-edge fetch` copies and `slag-edge bench query` times.

use std::io::Write;
use std::path::Path;

use glam::DVec3;
use serde::Serialize;
use slag_common::manifest::{self, CellRecord, EncoderRecord, Manifest, ShardRecord};
use slag_common::{Gaussians, Hash32};

use super::machine::Machine;
use super::timing::timed_ms;
use crate::generate::field::{Field, place_in_cube};
use slag_encoder::cells::{CellLimits, split};
use slag_encoder::codebook::{ScoreMetric, ScoreMetricContext};
use slag_encoder::progress::Progress;
use slag_encoder::shard::{self, CellEmbeddings, ShardSettings};
use slag_encoder::store::{Extras, Store, StoreError};
use slag_math::matrix::Rows;

/// Distance between neighbouring cells; more than their width, so that they do not overlap.
const CELL_PITCH_M: f64 = 21.0;

/// Figures of the published store.
#[derive(Clone, Debug, Serialize)]
pub struct FieldReport {
    /// The machine.
    pub machine: Machine,
    /// Gaussians.
    pub n_gaussians: u64,
    /// Cells.
    pub n_cells: usize,
    /// Centroids of all cells.
    pub n_centroids: u64,
    /// Bytes of all shards, by profile.
    pub shard_bytes: std::collections::BTreeMap<String, u64>,
    /// Gaussians coded per second on all threads: codebook, residual code, measured errors and files.
    pub gaussians_per_sec: f64,
    /// Mean score error relative to the spread, by profile, averaged over cells.
    pub mean_errors: std::collections::BTreeMap<String, f64>,
}

/// Publishes a field of `n_gaussians`, rounded down to whole cells. Its texts go to `texts.f32` in the same folder:
/// `[n][dim]`, little-endian.
///
/// # Errors
/// [`StoreError`].
pub fn publish(
    n_gaussians: usize,
    dim: usize,
    dir: &Path,
    settings: &ShardSettings,
    progress: &dyn Progress,
) -> Result<FieldReport, StoreError> {
    let field = Field::new(n_gaussians, dim);
    let store = Store::create_or_open(dir)?;
    let bank = field.texts();
    fs_err::File::create(dir.join("texts.f32"))?.write_all(bytemuck::cast_slice(&bank.vectors))?;
    let metric = ScoreMetric::new(dim, &bank);
    let first = field.embeddings(0);
    let score_context = ScoreMetricContext { spread: metric.spread(Rows::all(&first, dim)), metric, bank };
    let encoder_id = Hash32::of(b"generated-field");
    let n = field.cell_gaussians();
    let per_side = (field.n_cells() as f64).sqrt().ceil() as usize;
    let mut report = FieldReport {
        machine: Machine::here(),
        n_gaussians: (n * field.n_cells()) as u64,
        n_cells: field.n_cells(),
        n_centroids: 0,
        shard_bytes: Default::default(),
        gaussians_per_sec: 0.0,
        mean_errors: Default::default(),
    };
    let mut ms = 0.0;
    let mut cells = Vec::new();
    progress.begin("cells", "cell", field.n_cells() as u64, 0);
    for cell_id in 0..field.n_cells() {
        let corner = DVec3::new((cell_id % per_side) as f64, (cell_id / per_side) as f64, 0.0) * CELL_PITCH_M;
        let scene = Gaussians {
            means_in_world: (0..n as u64).map(|k| corner + place_in_cube(k)).collect(),
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[0.05; 3]; n],
            opacities: vec![1.0; n],
            sh_dc: vec![[0.0; 3]; n],
            ..Gaussians::default()
        };
        let vectors = field.embeddings(cell_id);
        let cut = split(&scene, CellLimits { max_gaussians: n, max_width: None });
        let cell = &cut.cells[0];
        let vectors: Vec<f32> =
            cell.gaussians.iter().flat_map(|k| &vectors[*k as usize * dim..][..dim]).copied().collect();
        let embeddings = CellEmbeddings { dim, vectors, has_evidence: vec![true; n] };
        let (built, took) = timed_ms(|| {
            shard::build(
                &scene,
                cell_id as u32,
                cell,
                &embeddings,
                encoder_id,
                &score_context,
                settings,
                None,
            )
        });
        ms += took;
        report.n_centroids += u64::from(built.n_centroids);
        let mut shards = std::collections::BTreeMap::new();
        for made in &built.shards {
            let (hash, len_bytes) = store.put_bytes(&made.bytes)?;
            let name = made.profile.to_string();
            *report.shard_bytes.entry(name.clone()).or_default() += len_bytes;
            *report.mean_errors.entry(name).or_default() +=
                f64::from(made.score_errors.mean / made.score_errors.spread) / field.n_cells() as f64;
            let record = ShardRecord {
                hash,
                len_bytes,
                n_centroids: built.n_centroids,
                score_error_bound: made.score_error_bound,
                score_errors: made.score_errors,
                position_error: built.position_error,
            };
            shards.insert(made.profile, record);
        }
        cells.push(CellRecord {
            cell_id: cell_id as u32,
            bounds: cell.bounds,
            n_gaussians: n as u32,
            shards,
        });
        progress.advance(1);
    }
    progress.end();
    report.gaussians_per_sec = report.n_gaussians as f64 / (ms / 1e3);
    store.publish(
        &Manifest {
            version: manifest::VERSION,
            scene: "generated-field".into(),
            generation: store.next_generation()?,
            created_unix_secs: 0,
            expires_unix_secs: None,
            next_key: None,
            metric: true,
            geo_reference: None,
            encoder: EncoderRecord {
                name: "generated-field".into(),
                id: encoder_id,
                dim: dim as u32,
                default_threshold: 0.5,
                calibration: None,
            },
            n_gaussians: report.n_gaussians,
            n_without_evidence: 0,
            n_rejected: 0,
            cells,
        },
        &Extras::new(),
    )?;
    store.prune()?;
    Ok(report)
}
