//! Publishes a store of a generated field, which robots fetch and `bench query` times.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Result;
use glam::DVec3;
use slag_common::manifest::{self, CellRecord, EncoderRecord, Manifest, ShardRecord};
use slag_common::shard::{Additions, Profile};
use slag_common::{Gaussians, Hash32};

use super::embeddings::{Field, place_in_cube};
use slag_encoder::cells::{CellLimits, PositionError, split};
use slag_encoder::codebook::{ScoreMetric, ScoreMetricContext};
use slag_encoder::progress::Progress;
use slag_encoder::shard::{CellEmbeddings, ShardBuilder, ShardSettings};
use slag_encoder::store::{Extras, Store};
use slag_math::matrix::Rows;

/// Distance between neighbouring cells; more than their width, so that they do not overlap.
const CELL_PITCH_M: f64 = 21.0;

/// Publishes a field of `n_gaussians`, rounded down to whole cells.
pub(super) fn publish(
    n_gaussians: usize,
    dim: usize,
    dir: &Path,
    profiles: Vec<Profile>,
    progress: &dyn Progress,
) -> Result<()> {
    let settings = ShardSettings { profiles, ..ShardSettings::default() };
    let field = Field::new(n_gaussians, dim);
    let store = Store::create_or_open(dir)?;
    let bank = field.texts();
    let metric = ScoreMetric::new(dim, &bank);
    let spread = metric.spread(Rows::all(&field.embeddings(0), dim));
    let context = ScoreMetricContext { spread, metric, bank };
    let n = field.cell_gaussians();
    let limits = CellLimits { position_error: PositionError::Within(0.01), ..CellLimits::by_count(n) };
    let per_side = (field.n_cells() as f64).sqrt().ceil() as usize;
    let id = Hash32::of(b"generated-field");
    let mut cells = Vec::new();
    progress.begin("cells", "cell", field.n_cells() as u64, 0);
    for cell_id in 0..field.n_cells() {
        let corner = DVec3::new((cell_id % per_side) as f64, (cell_id / per_side) as f64, 0.0) * CELL_PITCH_M;
        let scene = Gaussians::balls((0..n as u64).map(|k| corner + place_in_cube(k)).collect(), 0.05);
        let cell = &split(&scene, limits).cells[0];
        let vectors = field.embeddings(cell_id);
        let in_order = cell.gaussians.iter().flat_map(|k| &vectors[*k as usize * dim..][..dim]);
        let vectors = in_order.copied().collect();
        let embeddings = CellEmbeddings { dim, vectors, has_evidence: vec![true; n] };
        let cell_id = cell_id as u32;
        let builder =
            ShardBuilder { scene: &scene, encoder_id: id, score_context: &context, settings: &settings };
        let built = builder.build(cell_id, cell, &embeddings, None, Additions::default());
        let mut shards = BTreeMap::new();
        for made in &built.shards {
            let (hash, len_bytes) = store.put_bytes(&made.bytes)?;
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
        cells.push(CellRecord { cell_id, bounds: cell.bounds, n_gaussians: n as u32, shards });
        progress.advance(1);
    }
    progress.end();
    store.publish(&manifest(store.next_generation()?, id, dim, cells), &Extras::new())?;
    Ok(store.prune().map(|_| ())?)
}

fn manifest(generation: u64, id: Hash32, dim: usize, cells: Vec<CellRecord>) -> Manifest {
    Manifest {
        version: manifest::VERSION,
        scene: "generated-field".into(),
        generation,
        created_unix_secs: 0,
        metric: true,
        geo_reference: None,
        encoder: EncoderRecord {
            name: "generated-field".into(),
            id,
            dim: dim as u32,
            default_threshold: 0.5,
            calibration: None,
            text_model: None,
        },
        n_gaussians: cells.iter().map(|cell| u64::from(cell.n_gaussians)).sum(),
        n_without_evidence: 0,
        n_rejected: 0,
        cells,
    }
}
