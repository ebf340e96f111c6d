//! A generated scene, its store, and a text model of its space.

use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, PoisonError, RwLock};

use axum::Router;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use glam::DVec3;
use slag_common::Hash32;
use slag_common::frames::Aabb;
use slag_common::manifest::{self, CellRecord, EncoderRecord, Manifest, ShardRecord};
use slag_common::shard::{self, Positions, Profile, ScoreErrors, ShardHeader, ShardView};
use slag_common::tuf::one_key_repository;
use slag_models::{InferenceError, TextEncoder};

use crate::text::{EncoderInfo, TextService};
use slag_math::random::Random;

const CELL_GAUSSIANS: u32 = 65_536;
const CENTROIDS_PER_CELL: u32 = 256;
/// Number of concepts; a query asks for one of them.
pub(super) const N_CONCEPTS: u64 = 64;
const CELL_WIDTH_M: f64 = 25.0;
/// Between the scores of a concept's centroids (0.9 and more) and those of others (0.2 and less at 512
/// components).
const THRESHOLD: f32 = 0.6;

fn unit(mut vector: Vec<f32>) -> Vec<f32> {
    let length = vector.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt() as f32;
    vector.iter_mut().for_each(|v| *v /= length);
    vector
}

/// Returns the vector of a text that is a number.
pub(super) fn concept(number: u64, dim: u32) -> Vec<f32> {
    let mut random = Random::new(number % N_CONCEPTS + 1);
    unit((0..dim).map(|_| random.signed()).collect())
}

pub(super) fn encoder_id() -> Hash32 {
    Hash32::of(b"slag-edge bench")
}

/// Encodes a number as the concept of that number.
struct Concepts(u32);

impl TextEncoder for Concepts {
    fn name(&self) -> &str {
        "concepts"
    }

    fn dim(&self) -> usize {
        self.0 as usize
    }

    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError> {
        Ok(concept(text.trim().parse().unwrap_or(0), self.0))
    }
}

/// Starts the scene's text model.
pub(super) fn text_service(dim: u32) -> io::Result<TextService> {
    let info = EncoderInfo { name: "concepts".into(), id: encoder_id(), dim, execution_provider: "none" };
    TextService::start(info, Box::new(Concepts(dim)))
}

/// One generation, as a store serves it.
#[derive(Default)]
pub(super) struct Published {
    manifest: Vec<u8>,
    metadata: BTreeMap<String, Vec<u8>>,
    objects: BTreeMap<Hash32, Vec<u8>>,
}

/// A cell and its shard.
pub(super) struct Cell {
    pub bounds: Aabb,
    pub n_gaussians: u32,
    pub n_centroids: u32,
    pub shard: Vec<u8>,
}

impl Published {
    /// Lists and signs the cells of a generation.
    pub fn new(cells: Vec<Cell>, generation: u64, dim: u32, key: &ed25519_dalek::SigningKey) -> Self {
        let mut published = Self::default();
        let mut records = Vec::new();
        for (cell_id, Cell { bounds, n_gaussians, n_centroids, shard }) in (0..).zip(cells) {
            let record = ShardRecord {
                hash: Hash32::of(&shard),
                len_bytes: shard.len() as u64,
                n_centroids,
                score_error_bound: 0.1,
                score_errors: ScoreErrors::default(),
                position_error: 2e-4,
            };
            published.objects.insert(record.hash, shard);
            let shards = BTreeMap::from([(Profile::Compact, record)]);
            records.push(CellRecord { cell_id, bounds, n_gaussians, shards });
        }
        let manifest = Manifest {
            version: manifest::VERSION,
            scene: "generated".into(),
            generation,
            created_unix_secs: 1,
            metric: true,
            geo_reference: None,
            encoder: EncoderRecord {
                name: "concepts".into(),
                id: encoder_id(),
                dim,
                default_threshold: THRESHOLD,
                calibration: None,
                text_model: None,
            },
            n_gaussians: records.iter().map(|cell| u64::from(cell.n_gaussians)).sum(),
            n_without_evidence: 0,
            n_rejected: 0,
            cells: records,
        };
        published.manifest = manifest.to_bytes();
        published.metadata = one_key_repository(key, generation, manifest::TARGET, &published.manifest);
        published
    }
}

/// Generates successive generations of a scene; half of the cells change from one to the next.
pub(super) struct Generator {
    pub n_gaussians: u32,
    pub dim: u32,
    pub key: ed25519_dalek::SigningKey,
}

impl Generator {
    pub fn generation(&self, generation: u64) -> io::Result<Published> {
        let cell = |cell_id: u32| {
            let n_gaussians = CELL_GAUSSIANS.min(self.n_gaussians - cell_id * CELL_GAUSSIANS);
            let content = (generation + u64::from(cell_id)) / 2;
            let shard = self.shard(cell_id, n_gaussians, content)?;
            let n_centroids = CENTROIDS_PER_CELL.min(n_gaussians);
            Ok(Cell { bounds: bounds(cell_id), n_gaussians, n_centroids, shard })
        };
        let cells: io::Result<Vec<Cell>> = (0..self.n_gaussians.div_ceil(CELL_GAUSSIANS)).map(cell).collect();
        Ok(Published::new(cells?, generation, self.dim, &self.key))
    }

    fn shard(&self, cell_id: u32, n: u32, content: u64) -> io::Result<Vec<u8>> {
        let mut random = Random::new((u64::from(cell_id) << 32) ^ content);
        let n_centroids = CENTROIDS_PER_CELL.min(n);
        let centroid_starts: Vec<u32> = (0..=n_centroids)
            .map(|centroid| (u64::from(centroid) * u64::from(n) / u64::from(n_centroids)) as u32)
            .collect();
        let mut codebook: Vec<f32> = Vec::new();
        // Members of a centroid are close together, as in real scenes.
        let mut positions: Vec<[u16; 3]> = Vec::new();
        for centroid in 0..n_centroids {
            let spread = 0.4 / (self.dim as f32 / 3.0).sqrt();
            let around = concept(random.bits(), self.dim);
            let vector = unit(around.into_iter().map(|v| v + spread * random.signed()).collect());
            codebook.extend(vector);
            let centre = [(); 3].map(|()| random.bits() % 60_000);
            for _ in centroid_starts[centroid as usize]..centroid_starts[centroid as usize + 1] {
                positions.push(centre.map(|c| (c + random.bits() % 5000) as u16));
            }
        }
        let (centroids, centroid_step) = shard::quantise(&codebook);
        let box_ = bounds(cell_id);
        let header = ShardHeader {
            cell_id,
            n_gaussians: n,
            n_centroids,
            dim: self.dim,
            n_components: self.dim,
            n_subspaces: 0,
            position_bits: [16, 16, 16, 0],
            centroid_step,
            origin_in_world: box_.min.into(),
            position_step: [CELL_WIDTH_M / 65535.0; 3],
            box_min: box_.min.into(),
            box_max: box_.max.into(),
            errors: ScoreErrors::default(),
            encoder_id: encoder_id().0,
        };
        let radii = vec![0.1; n_centroids as usize];
        let mut out = Vec::new();
        let parts = ShardView {
            header,
            positions: Positions::Wide(&positions),
            centroid_starts: &centroid_starts,
            centroids: &centroids,
            radii: &radii,
            basis: None,
            residuals: None,
            exact: None,
            packed_indices: None,
        };
        parts.write(&mut out)?;
        Ok(out)
    }
}

/// Cells lie in a line along x.
fn bounds(cell_id: u32) -> Aabb {
    let min = DVec3::X * (f64::from(cell_id) * CELL_WIDTH_M);
    Aabb { min, max: min + DVec3::splat(CELL_WIDTH_M) }
}

/// The generation that a store serves now.
pub(super) type Shelf = Arc<RwLock<Published>>;

/// Returns the routes of a store that robots can fetch from.
pub(super) fn store(shelf: Shelf) -> Router {
    async fn metadata(State(shelf): State<Shelf>, Path(name): Path<String>) -> Response {
        let shelf = shelf.read().unwrap_or_else(PoisonError::into_inner);
        match shelf.metadata.get(&name) {
            Some(bytes) => bytes.clone().into_response(),
            None => StatusCode::NOT_FOUND.into_response(),
        }
    }
    async fn manifest(State(shelf): State<Shelf>) -> Vec<u8> {
        shelf.read().unwrap_or_else(PoisonError::into_inner).manifest.clone()
    }
    async fn object(State(shelf): State<Shelf>, Path(hash): Path<String>) -> Response {
        let shelf = shelf.read().unwrap_or_else(PoisonError::into_inner);
        match hash.parse().ok().and_then(|hash: Hash32| shelf.objects.get(&hash)) {
            Some(bytes) => bytes.clone().into_response(),
            None => StatusCode::NOT_FOUND.into_response(),
        }
    }
    Router::new()
        .route("/v1/metadata/{name}", get(metadata))
        .route("/v1/targets/{name}", get(manifest))
        .route("/v1/objects/{hash}", get(object))
        .with_state(shelf)
}
