//! Caches of random centroids and codes with realistic proportions: sizes and skipping are realistic,
//! contents are not.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DVec3;
use half::f16;
use slag_common::Hash32;
use slag_common::frames::Aabb;
use slag_common::manifest::{self, CellRecord, EncoderRecord, Manifest, ShardRecord};
use slag_common::objects::{NO_OBJECT, ObjectRecord, Objects, ObjectsHeader, collect_runs, quantise_vectors};
use slag_common::shard::{
    BLOCK, Basis, CODEWORDS, Positions, Profile, Residuals, ScoreErrors, ShardHeader, ShardView, quantise,
};
use slag_edge::store::{Current, CurrentCell, EdgeCache};
use slag_math::random::Random;

/// Gaussians of a cell.
const CELL: usize = 65_536;
/// Mean number of Gaussians of a centroid.
const CENTROID: usize = 50;
/// Kinds of things in a cell.
const KINDS: usize = 24;
/// Vectors of an object.
const N_VECTORS: usize = 5;
/// One object in so many reaches into the next cell.
const REACHING: usize = 10;

pub struct SceneSpec {
    pub n_gaussians: usize,
    pub dim: usize,
    pub n_components: usize,
    pub n_subspaces: usize,
    pub is_balanced: bool,
    /// Objects in all cells, distributed evenly.
    pub n_objects: usize,
}

/// Returns a value of variance 1, about normal.
fn normal(random: &mut Random) -> f32 {
    (0..3).map(|_| random.signed()).sum()
}

fn normals(random: &mut Random, n: usize, scale: f32) -> Vec<f32> {
    (0..n).map(|_| normal(random) * scale).collect()
}

/// Writes a cache as a fetch leaves it.
pub fn write_cache(dir: &Path, spec: &SceneSpec) {
    let cache = EdgeCache::open(dir);
    for folder in ["shards", "manifests"] {
        std::fs::create_dir_all(dir.join(folder)).expect("a folder");
    }
    let profile = if spec.is_balanced { Profile::Balanced } else { Profile::Compact };
    let mut cells = Vec::new();
    for start in (0..spec.n_gaussians).step_by(CELL) {
        let n = CELL.min(spec.n_gaussians - start);
        let cell_id = (start / CELL) as u32;
        let (bytes, bounds, n_centroids) = shard(cell_id, n, spec);
        let hash = Hash32::of(&bytes);
        let record = ShardRecord {
            hash,
            len_bytes: bytes.len() as u64,
            n_centroids,
            score_error_bound: 0.5,
            score_errors: ScoreErrors::default(),
            position_error: 0.01,
        };
        std::fs::write(cache.shard_path(hash), bytes).expect("a file");
        let shards = BTreeMap::from([(profile, record)]);
        cells.push(CellRecord { cell_id, bounds, n_gaussians: n as u32, shards });
    }
    let manifest = Manifest {
        version: manifest::VERSION,
        scene: "generated".into(),
        generation: 1,
        created_unix_secs: 1_700_000_000,
        metric: true,
        geo_reference: None,
        encoder: EncoderRecord {
            name: "random".into(),
            id: Hash32([3; 32]),
            dim: spec.dim as u32,
            default_threshold: 0.2,
            calibration: None,
            text_model: None,
        },
        n_gaussians: spec.n_gaussians as u64,
        n_without_evidence: 0,
        n_rejected: 0,
        cells,
    };
    let bytes = manifest.to_bytes();
    let current = Current {
        manifest_hash: Hash32::of(&bytes),
        profile,
        centre_in_world: DVec3::ZERO,
        radius: 1e6,
        bad_cells: Vec::new(),
        cells: manifest
            .cells
            .iter()
            .map(|cell| {
                let record = &cell.shards[&profile];
                CurrentCell { cell_id: cell.cell_id, hash: record.hash, len_bytes: record.len_bytes }
            })
            .collect(),
    };
    std::fs::write(cache.manifest_path(current.manifest_hash), &bytes).expect("a file");
    std::fs::write(cache.current_path(), serde_json::to_vec(&current).expect("JSON")).expect("a file");
}

fn shard(cell_id: u32, n: usize, spec: &SceneSpec) -> (Vec<u8>, Aabb, u32) {
    let mut random = Random::new(u64::from(cell_id) << 32 | 5);
    let (dim, m) = (spec.dim, spec.n_components);
    // One in a hundred was never seen.
    let n_with_evidence = n - n / 100;
    let mut centroid_starts = vec![0u32];
    let mut at = 0;
    while at < n_with_evidence {
        // From 1 to several hundred members: half the centroids are short.
        let len = match random.below(2) {
            0 => 1 + random.below(CENTROID),
            _ => 1 + random.below(3 * CENTROID),
        };
        at = n_with_evidence.min(at + len);
        centroid_starts.push(at as u32);
    }
    let k = centroid_starts.len() - 1;
    // Components decay as in a principal component analysis; centroids of a kind are alike.
    let fall: Vec<f32> = (0..m).map(|c| 1.0 / (1.0 + c as f32 / 6.0)).collect();
    let squares: f32 = fall.iter().map(|f| f * f).sum();
    let fall: Vec<f32> = fall.iter().map(|f| f / squares.sqrt()).collect();
    let kinds = normals(&mut random, KINDS * m, 0.7);
    let mut centroids = Vec::with_capacity(k * m);
    let mut kind = 0;
    for centroid in 0..k {
        if centroid % 16 == 0 {
            kind = random.below(KINDS);
        }
        centroids.extend((0..m).map(|c| (kinds[kind * m + c] + 0.35 * normal(&mut random)) * fall[c]));
    }
    let (centroids, centroid_step) = quantise(&centroids);
    let (vectors, step) = quantise(&normals(&mut random, m * dim, 1.0 / (dim as f32).sqrt()));
    let steps = vec![step; m];
    let mean: Vec<f16> =
        normals(&mut random, dim, 0.6 / (dim as f32).sqrt()).into_iter().map(f16::from_f32).collect();
    let subspace_starts: Vec<u32> =
        (0..=spec.n_subspaces).map(|g| (m * g / spec.n_subspaces) as u32).collect();
    let codewords = normals(&mut random, CODEWORDS * m, 0.2);
    let codewords: Vec<f16> = subspace_starts
        .windows(2)
        .flat_map(|starts| (0..CODEWORDS).flat_map(move |_| starts[0]..starts[1]))
        .zip(&codewords)
        .map(|(c, w)| f16::from_f32(w * fall[c as usize]))
        .collect();
    let residual_scales: Vec<f32> = (0..k).map(|_| 0.4 + random.below(100) as f32 / 80.0).collect();
    let residual_norms: Vec<f32> = residual_scales.iter().map(|scale| scale * 0.45).collect();
    let codes: Vec<u8> = (0..n_with_evidence.div_ceil(BLOCK) * BLOCK * spec.n_subspaces / 16)
        .flat_map(|_| random.bits().to_le_bytes())
        .collect();
    let positions: Vec<u32> = (0..n).map(|_| random.bits() as u32).collect();
    let radii = vec![0.1; k];
    let (x, y) = (f64::from(cell_id % 16) * 20.0, f64::from(cell_id / 16) * 20.0);
    let bounds = Aabb { min: DVec3::new(x, y, 0.0), max: DVec3::new(x + 20.48, y + 20.48, 10.24) };
    let header = ShardHeader {
        cell_id,
        n_gaussians: n as u32,
        n_centroids: k as u32,
        dim: dim as u32,
        n_components: m as u32,
        n_subspaces: if spec.is_balanced { spec.n_subspaces as u32 } else { 0 },
        position_bits: [11, 11, 10, 0],
        centroid_step,
        origin_in_world: bounds.min.to_array(),
        position_step: [0.01; 3],
        box_min: bounds.min.to_array(),
        box_max: bounds.max.to_array(),
        errors: ScoreErrors::default(),
        encoder_id: [3; 32],
    };
    let here = objects_of(cell_id, spec);
    let of_objects = (!here.is_empty()).then(|| {
        CellObjects::new(&here, n, m, bounds, |random| {
            let kind = random.below(KINDS);
            (0..m).map(|c| (kinds[kind * m + c] + 0.35 * normal(random)) * fall[c]).collect()
        })
    });
    let residuals = Residuals {
        subspace_starts: &subspace_starts,
        codewords: &codewords,
        residual_scales: &residual_scales,
        residual_norms: &residual_norms,
        codes: &codes,
    };
    let mut bytes = Vec::new();
    ShardView {
        header,
        positions: Positions::Packed(&positions),
        centroid_starts: &centroid_starts,
        centroids: &centroids,
        radii: &radii,
        basis: Some(Basis { mean: &mean, vectors: &vectors, steps: &steps }),
        residuals: spec.is_balanced.then_some(residuals),
        exact: None,
        packed_indices: None,
    }
    .write_with(&mut bytes, of_objects.as_ref().map(CellObjects::view).as_ref())
    .expect("writes to memory");
    (bytes, bounds, k as u32)
}

/// Returns the objects with Gaussians in a cell: its own, and those that reach into it from the previous
/// cell.
fn objects_of(cell_id: u32, spec: &SceneSpec) -> Vec<u64> {
    let n_cells = spec.n_gaussians.div_ceil(CELL);
    let own = |cell: usize| spec.n_objects * cell / n_cells..spec.n_objects * (cell + 1) / n_cells;
    let cell = cell_id as usize;
    let before = cell.checked_sub(1).map(own).into_iter().flatten().filter(|object| object % REACHING == 0);
    before.chain(own(cell)).map(|object| object as u64).collect()
}

/// The columns of a cell's objects.
struct CellObjects {
    header: ObjectsHeader,
    records: Vec<ObjectRecord>,
    vectors: Vec<i8>,
    steps: Vec<f32>,
    run_ends: Vec<u32>,
    run_objects: Vec<u16>,
    photos: String,
}

impl CellObjects {
    /// Assigns runs of Gaussians to the objects in turn, three to each, and leaves a tenth to none.
    fn new(ids: &[u64], n: usize, m: usize, bounds: Aabb, vector: impl Fn(&mut Random) -> Vec<f32>) -> Self {
        let n_turns = 3 * ids.len();
        let start = |turn: usize| (n - n / 10) * turn / n_turns;
        let mut object_of = vec![NO_OBJECT; n];
        let mut n_here = vec![0; ids.len()];
        for turn in 0..n_turns {
            let (run, number) = (start(turn)..start(turn + 1), turn % ids.len());
            n_here[number] += run.len() as u32;
            object_of[run].fill(number as u16);
        }
        let (run_ends, run_objects) = collect_runs(object_of);
        let mut random = Random::new(ids[0] + 77);
        let (mut vectors, mut steps) = (Vec::new(), Vec::new());
        for _ in ids {
            let sides: Vec<f32> = (0..N_VECTORS).flat_map(|_| vector(&mut random)).collect();
            let (components, of_vectors) = quantise_vectors(&sides, m, N_VECTORS);
            vectors.extend(components);
            steps.extend(of_vectors);
        }
        let record = |(number, id): (usize, &u64)| ObjectRecord {
            id: *id,
            position_in_world: ((bounds.min + bounds.max) * 0.5).to_array(),
            box_min: bounds.min.to_array(),
            box_max: bounds.max.to_array(),
            n_gaussians: 2 * n as u32,
            n_gaussians_here: n_here[number],
            photo_box_px: [1, 2, 30, 40],
            photo_start: 0,
            photo_bytes: 12,
        };
        let photos: String = (0..ids.len().min(300)).map(|photo| format!("frame{photo:03}.jpg")).collect();
        Self {
            header: ObjectsHeader {
                n_objects: ids.len() as u32,
                n_vectors: N_VECTORS as u32,
                n_runs: run_ends.len() as u32,
                photos_bytes: photos.len() as u32,
                score_mean: 0.0,
                score_spread: 0.06,
                score_error_bound: 0.05,
            },
            records: ids.iter().enumerate().map(record).collect(),
            vectors,
            steps,
            run_ends,
            run_objects,
            photos,
        }
    }

    fn view(&self) -> Objects<'_> {
        Objects {
            header: self.header,
            records: &self.records,
            vectors: &self.vectors,
            steps: &self.steps,
            run_ends: &self.run_ends,
            run_objects: &self.run_objects,
            photos: self.photos.as_bytes(),
        }
    }
}
