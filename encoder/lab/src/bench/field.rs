//! `bench field`: publishes a store of a generated field, which `slag-edge fetch` copies and `slag-edge bench query` times.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

use glam::DVec3;
use serde::Serialize;
use slag_common::manifest::{self, CellRecord, EncoderRecord, Manifest, ShardRecord};
use slag_common::{Gaussians, Hash32};

use super::machine::Machine;
use super::timing::timed_ms;
use crate::generate::field::{Field, place_in_cube};
use slag_encoder::cells::{Cell, CellLimits, PositionError, split};
use slag_encoder::codebook::{ScoreMetric, ScoreMetricContext};
use slag_encoder::progress::Progress;
use slag_encoder::shard::{self, CellEmbeddings, CellExtras, ShardSettings};
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
    pub shard_bytes: BTreeMap<String, u64>,
    /// Gaussians coded per second on all threads: codebook, residual code, measured errors and files.
    pub gaussians_per_sec: f64,
    /// Mean score error relative to the spread, by profile, averaged over cells.
    pub mean_errors: BTreeMap<String, f64>,
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
    let mut writer = FieldWriter::create(dir, &field, dim, settings)?;
    let n = field.cell_gaussians();
    let limits = CellLimits { position_error: PositionError::Within(0.01), ..CellLimits::by_count(n) };
    let per_side = (field.n_cells() as f64).sqrt().ceil() as usize;
    progress.begin("cells", "cell", field.n_cells() as u64, 0);
    for cell_id in 0..field.n_cells() {
        let corner = DVec3::new((cell_id % per_side) as f64, (cell_id / per_side) as f64, 0.0) * CELL_PITCH_M;
        let scene = grey_gaussians((0..n as u64).map(|k| corner + place_in_cube(k)).collect());
        let cut = split(&scene, limits);
        writer.add(&scene, &cut.cells[0], &field.embeddings(cell_id))?;
        progress.advance(1);
    }
    progress.end();
    writer.publish()
}

/// Returns opaque round Gaussians at these means.
pub(super) fn grey_gaussians(means_in_world: Vec<DVec3>) -> Gaussians {
    let n = means_in_world.len();
    Gaussians {
        means_in_world,
        rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; n],
        scales: vec![[0.05; 3]; n],
        opacities: vec![1.0; n],
        sh_dc: vec![[0.0; 3]; n],
        ..Gaussians::default()
    }
}

/// Writes a store of a field cell by cell.
pub(super) struct FieldWriter<'a> {
    store: Store,
    settings: &'a ShardSettings,
    score_context: ScoreMetricContext,
    dim: usize,
    cells: Vec<CellRecord>,
    report: FieldReport,
    coding_ms: f64,
}

impl<'a> FieldWriter<'a> {
    /// Creates or opens a store, and writes the field's texts.
    pub(super) fn create(
        dir: &Path,
        field: &Field,
        dim: usize,
        settings: &'a ShardSettings,
    ) -> Result<Self, StoreError> {
        let store = Store::create_or_open(dir)?;
        let bank = field.texts();
        fs_err::File::create(dir.join("texts.f32"))?.write_all(bytemuck::cast_slice(&bank.vectors))?;
        let metric = ScoreMetric::new(dim, &bank);
        let first = field.embeddings(0);
        let spread = metric.spread(Rows::all(&first, dim));
        let report = FieldReport {
            machine: Machine::here(),
            n_gaussians: 0,
            n_cells: 0,
            n_centroids: 0,
            shard_bytes: BTreeMap::new(),
            gaussians_per_sec: 0.0,
            mean_errors: BTreeMap::new(),
        };
        let score_context = ScoreMetricContext { spread, metric, bank };
        Ok(Self { store, settings, score_context, dim, cells: Vec::new(), report, coding_ms: 0.0 })
    }

    /// Adds a cell. `vectors`: the embeddings of the scene's Gaussians, `[n][dim]`.
    pub(super) fn add(&mut self, scene: &Gaussians, cell: &Cell, vectors: &[f32]) -> Result<(), StoreError> {
        let (n, dim, cell_id) = (cell.gaussians.len(), self.dim, self.cells.len() as u32);
        let vectors: Vec<f32> =
            cell.gaussians.iter().flat_map(|k| &vectors[*k as usize * dim..][..dim]).copied().collect();
        let embeddings = CellEmbeddings { dim, vectors, has_evidence: vec![true; n] };
        let (context, settings) = (&self.score_context, self.settings);
        let (built, ms) = timed_ms(|| {
            shard::build(
                scene,
                cell_id,
                cell,
                &embeddings,
                encoder_id(),
                context,
                settings,
                &CellExtras::default(),
            )
        });
        self.coding_ms += ms;
        self.report.n_gaussians += n as u64;
        self.report.n_cells += 1;
        self.report.n_centroids += u64::from(built.n_centroids);
        let mut shards = BTreeMap::new();
        for made in &built.shards {
            let (hash, len_bytes) = self.store.put_bytes(&made.bytes)?;
            let name = made.profile.to_string();
            *self.report.shard_bytes.entry(name.clone()).or_default() += len_bytes;
            *self.report.mean_errors.entry(name).or_default() +=
                f64::from(made.score_errors.mean / made.score_errors.spread);
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
        self.cells.push(CellRecord { cell_id, bounds: cell.bounds, n_gaussians: n as u32, shards });
        Ok(())
    }

    /// Publishes the cells as the store's next generation.
    pub(super) fn publish(mut self) -> Result<FieldReport, StoreError> {
        self.report.gaussians_per_sec = self.report.n_gaussians as f64 / (self.coding_ms / 1e3);
        let n_cells = self.report.n_cells.max(1) as f64;
        self.report.mean_errors.values_mut().for_each(|error| *error /= n_cells);
        let manifest = Manifest {
            version: manifest::VERSION,
            scene: "generated-field".into(),
            generation: self.store.next_generation()?,
            created_unix_secs: 0,
            metric: true,
            geo_reference: None,
            encoder: EncoderRecord {
                name: "generated-field".into(),
                id: encoder_id(),
                dim: self.dim as u32,
                default_threshold: 0.5,
                calibration: None,
                text_model: None,
            },
            n_gaussians: self.report.n_gaussians,
            n_without_evidence: 0,
            n_rejected: 0,
            cells: self.cells,
        };
        self.store.publish(&manifest, &Extras::new())?;
        self.store.prune()?;
        Ok(self.report)
    }
}

fn encoder_id() -> Hash32 {
    Hash32::of(b"generated-field")
}
