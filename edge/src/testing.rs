//! Small real shards and caches for tests, and a text encoder with one axis per text.

pub mod coded;

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};

use glam::DVec3;
use half::f16;
use slag_common::container::AlignedBytes;
use slag_common::frames::Aabb;
use slag_common::hash::Hash32;
use slag_common::manifest::{Calibration, Manifest};
use slag_common::occupancy::BuiltOccupancy;
use slag_common::shard::sample::{self, SampleObject, SampleObjects};
use slag_common::shard::{
    Additions, ExactColumns, IndexColumn, Positions, Profile, ShardHeader, ShardLayout, ShardView, quantise,
};
use slag_models::{InferenceError, TextEncoder};

use crate::store::{Current, CurrentCell, EdgeCache};
use crate::text::{EncoderInfo, TextService};

#[derive(Clone, Debug)]
pub struct Member {
    pub steps: [u16; 3],
    pub embedding: Vec<f32>,
}

#[derive(Clone, Debug)]
pub struct TestShard {
    pub cell_id: u32,
    pub origin: DVec3,
    pub step: DVec3,
    pub encoder_id: Hash32,
    /// Whether centroids are quantised with a power-of-two step, so that values exact in f32 stay exact.
    pub has_exact_centroids: bool,
    /// Whether the shard has the input splat's indices in any profile.
    pub has_packed_indices: bool,
    pub centroids: Vec<Vec<Member>>,
    /// Gaussians without a centroid, after the others.
    pub without_evidence: Vec<[u16; 3]>,
}

/// A shard's bytes and the unrounded embeddings of its Gaussians.
pub struct BuiltShard {
    pub bytes: AlignedBytes,
    pub layout: ShardLayout,
    pub embeddings: Vec<Vec<f32>>,
}

pub struct TestObject {
    pub id: u64,
    /// In components of the shard's centroids.
    pub vectors: Vec<f32>,
    pub runs: Vec<std::ops::Range<u32>>,
    pub n_gaussians: u32,
}

pub(crate) const CALIBRATION: Calibration = Calibration { score_mean: 0.0, score_spread: 0.1 };

impl BuiltShard {
    pub(crate) fn with(&self, additions: Additions<'_>) -> Self {
        let mut bytes = Vec::new();
        self.view().write_with(&mut bytes, additions).expect("writes to memory");
        Self::read(&bytes, self.embeddings.clone())
    }

    /// Rewrites the shard with objects: boxes around the origin, photos named by their ids.
    pub(crate) fn with_objects(&self, objects: &[TestObject], calibration: Calibration) -> Self {
        self.with_objects_and_places(objects, calibration, None)
    }

    /// As [`Self::with_objects`], with occupancy.
    pub(crate) fn with_objects_and_places(
        &self,
        objects: &[TestObject],
        calibration: Calibration,
        places: Option<&BuiltOccupancy>,
    ) -> Self {
        let object = |object: &TestObject| {
            let at = DVec3::X * object.id as f64;
            SampleObject {
                id: object.id,
                position_in_world: at,
                bounds: Aabb { min: at - 1.0, max: at + 1.0 },
                vectors: object.vectors.clone(),
                runs: object.runs.clone(),
                n_gaussians: object.n_gaussians,
                photo: format!("{}.jpg", object.id),
                photo_box_px: [1, 2, 30, 40],
                thumbnail: b"\xff\xd8\xff\xe0".to_vec(),
            }
        };
        let Calibration { score_mean, score_spread } = calibration;
        let objects = objects.iter().map(object).collect();
        let objects = SampleObjects { objects, score_mean, score_spread, score_error_bound: 0.005 };
        let others = Additions { occupancy: places.map(BuiltOccupancy::view), ..Additions::default() };
        Self::read(&objects.add_to(&self.view(), others), self.embeddings.clone())
    }

    fn read(bytes: &[u8], embeddings: Vec<Vec<f32>>) -> Self {
        let bytes = AlignedBytes::copy_of(bytes);
        let layout = ShardLayout::check(&bytes).expect("a valid shard");
        Self { bytes, layout, embeddings }
    }

    pub fn view(&self) -> ShardView<'_> {
        self.layout.view(&self.bytes)
    }
}

impl TestShard {
    pub fn new(centroids: Vec<Vec<Member>>) -> Self {
        let (origin, step) = (DVec3::ZERO, DVec3::splat(0.01));
        let (encoder_id, without_evidence) = (Hash32([7; 32]), Vec::new());
        Self {
            cell_id: 1,
            origin,
            step,
            encoder_id,
            has_exact_centroids: false,
            has_packed_indices: false,
            centroids,
            without_evidence,
        }
    }

    /// Writes the shard and reads it back; centroids are means, radii the largest distance of an unrounded embedding.
    pub fn build(&self, exact: bool) -> BuiltShard {
        let members = || self.centroids.iter().flatten();
        let dim = members().next().map_or(2, |m| m.embedding.len());
        let mut centroid_starts = vec![0u32];
        let mut means = Vec::new();
        for centroid in &self.centroids {
            centroid_starts.push(centroid_starts.last().expect("starts with 0") + centroid.len() as u32);
            let sum = |c: usize| centroid.iter().map(|m| f64::from(m.embedding[c])).sum::<f64>();
            means.extend((0..dim).map(|c| (sum(c) / centroid.len() as f64) as f32));
        }
        let (centroids, centroid_step) =
            if self.has_exact_centroids { quantise_exactly(&means) } else { quantise(&means) };
        let radius = |(centroid, stored): (&Vec<Member>, &[i8])| {
            let stored = || stored.iter().map(|v| f64::from(*v) * f64::from(centroid_step));
            let squares = |m: &Member| -> f64 {
                m.embedding.iter().zip(stored()).map(|(e, p)| (f64::from(*e) - p).powi(2)).sum()
            };
            centroid.iter().map(squares).fold(0.0, f64::max).sqrt() as f32 * (1.0 + f32::EPSILON)
        };
        let radii: Vec<f32> = self.centroids.iter().zip(centroids.chunks(dim)).map(radius).collect();
        let positions: Vec<[u16; 3]> =
            members().map(|m| m.steps).chain(self.without_evidence.iter().copied()).collect();
        let embeddings: Vec<f16> =
            members().flat_map(|m| m.embedding.iter().map(|v| f16::from_f32(*v))).collect();
        let input_indices: Vec<u32> = (0..positions.len() as u32).map(|i| i * 3 + 1).collect();
        let bounds = Aabb { min: self.origin, max: self.origin + self.step * 65535.0 };
        let (n, k) = (positions.len(), self.centroids.len());
        let header = ShardHeader {
            centroid_step,
            position_step: self.step.to_array(),
            encoder_id: self.encoder_id.0,
            ..sample::header(self.cell_id, n, k, dim, bounds)
        };
        let packed = IndexColumn::pack(&input_indices);
        let exact = exact.then_some(ExactColumns {
            input_indices: &input_indices,
            embeddings: &embeddings,
            fine: None,
        });
        let mut bytes = Vec::new();
        ShardView {
            header,
            positions: Positions::Wide(&positions),
            centroid_starts: &centroid_starts,
            centroids: &centroids,
            radii: &radii,
            basis: None,
            residuals: None,
            exact,
            packed_indices: self.has_packed_indices.then(|| packed.view()),
        }
        .write(&mut bytes)
        .expect("writes to memory");
        BuiltShard::read(&bytes, members().map(|m| m.embedding.clone()).collect())
    }
}

/// Quantises to 8 bits with a power-of-two step.
fn quantise_exactly(values: &[f32]) -> (Vec<i8>, f32) {
    let largest = values.iter().fold(f32::MIN_POSITIVE, |most, v| most.max(v.abs()));
    let step = (largest / 127.0).log2().ceil().exp2();
    (values.iter().map(|v| (v / step).round() as i8).collect(), step)
}

pub fn normalised(vector: Vec<f32>) -> Vec<f32> {
    let length = vector.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    vector.into_iter().map(|v| (f64::from(v) / length) as f32).collect()
}

/// Blocks threads until open.
pub type Gate = Arc<(Mutex<bool>, Condvar)>;

pub fn open_gate(gate: &Gate) {
    *gate.0.lock().expect("no panic inside") = true;
    gate.1.notify_all();
}

/// A text encoder whose texts are numbers of axes; `wait` waits for the gate, `panic` panics.
pub struct Axes {
    dim: usize,
    words: Vec<String>,
    gate: Gate,
    n_encoded: Arc<AtomicUsize>,
}

impl Axes {
    pub fn new(dim: usize) -> Self {
        let words = (0..dim).map(|axis| axis.to_string()).collect();
        Self { dim, words, gate: Gate::default(), n_encoded: Arc::default() }
    }

    pub fn info(dim: usize) -> EncoderInfo {
        let id = TestShard::new(Vec::new()).encoder_id;
        EncoderInfo { name: "axes".into(), id, dim: dim as u32, execution_provider: "none" }
    }
}

impl TextEncoder for Axes {
    fn dim(&self) -> usize {
        self.dim
    }

    fn vocabulary(&self) -> Option<&[String]> {
        Some(&self.words)
    }

    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError> {
        self.n_encoded.fetch_add(1, Ordering::SeqCst);
        let axis = match text {
            "panic" => panic!("asked to"),
            "wait" => {
                let open = self.gate.0.lock().expect("no panic inside");
                drop(self.gate.1.wait_while(open, |open| !*open).expect("no panic inside"));
                0
            }
            // The first word alone counts, so that a text may have others.
            _ => {
                let axis = text.split_whitespace().next().and_then(|word| word.parse().ok());
                axis.filter(|axis| *axis < self.dim).ok_or_else(|| InferenceError::UnknownPhrase {
                    text: text.into(),
                    n_known: self.dim,
                    near: vec!["0".into()],
                })?
            }
        };
        Ok((0..self.dim).map(|i| f32::from(i == axis)).collect())
    }
}

/// Returns a service over [`Axes`] and the number of texts that it encoded.
pub fn axes_service(dim: usize, gate: Gate) -> (TextService, Arc<AtomicUsize>) {
    let axes = Axes { gate, ..Axes::new(dim) };
    let n_encoded = Arc::clone(&axes.n_encoded);
    (TextService::start(Axes::info(dim), Box::new(axes)).expect("a thread"), n_encoded)
}

/// Returns the manifest of some shards in [`Axes`]' space.
pub fn manifest_of(shards: &[BuiltShard], generation: u64) -> Manifest {
    let listed: Vec<_> = shards.iter().map(|shard| (Profile::Compact, &*shard.bytes)).collect();
    let mut manifest = Manifest { generation, ..sample::manifest("yard", &listed) };
    (manifest.encoder.name, manifest.encoder.default_threshold) = ("axes".into(), 0.5);
    manifest
}

/// Writes a cache as a fetch leaves it, replacing `current` last.
pub fn write_cache(dir: &Path, shards: &[BuiltShard], generation: u64) {
    write_manifest(dir, shards, manifest_of(shards, generation));
}

/// As [`write_cache`], with a manifest that may say more.
pub fn write_manifest(dir: &Path, shards: &[BuiltShard], manifest: Manifest) {
    let bytes = manifest.to_bytes();
    let current = Current {
        manifest_hash: Hash32::of(&bytes),
        profile: Profile::Compact,
        centre_in_world: DVec3::ZERO,
        radius: 50.0,
        bad_cells: Vec::new(),
        cells: manifest
            .cells
            .iter()
            .map(|cell| {
                let record = &cell.shards[&Profile::Compact];
                CurrentCell { cell_id: cell.cell_id, hash: record.hash, len_bytes: record.len_bytes }
            })
            .collect(),
    };
    let cache = EdgeCache::open(dir);
    for folder in ["shards", "manifests"] {
        fs_err::create_dir_all(dir.join(folder)).expect("a folder");
    }
    for shard in shards {
        fs_err::write(cache.shard_path(Hash32::of(&shard.bytes)), &*shard.bytes).expect("a file");
    }
    fs_err::write(cache.manifest_path(current.manifest_hash), &bytes).expect("a file");
    let staged = dir.join("current.new");
    fs_err::write(&staged, serde_json::to_vec(&current).expect("JSON")).expect("a file");
    fs_err::rename(staged, cache.current_path()).expect("a rename");
}
