//! Shards of plain columns for tests and benchmarks.

use std::collections::BTreeMap;
use std::ops::Range;

use glam::DVec3;
use half::f16;

use super::{Additions, ExactColumns, Positions, Profile, ScoreErrors, ShardHeader, ShardLayout, ShardView};
use crate::Hash32;
use crate::container::AlignedBytes;
use crate::frames::Aabb;
use crate::manifest::{self, CellRecord, EncoderRecord, Manifest, ShardRecord};
use crate::objects::{
    NO_OBJECT, ObjectRecord, Objects, ObjectsHeader, Thumbnails, collect_runs, quantise_vectors,
};

/// Returns the header of a shard without basis and codes, with 16-bit positions over a box.
pub fn header(cell_id: u32, n_gaussians: usize, n_centroids: usize, dim: usize, bounds: Aabb) -> ShardHeader {
    ShardHeader {
        cell_id,
        n_gaussians: n_gaussians as u32,
        n_centroids: n_centroids as u32,
        dim: dim as u32,
        n_components: dim as u32,
        n_subspaces: 0,
        position_bits: [16, 16, 16, 0],
        centroid_step: 1.0,
        origin_in_world: bounds.min.into(),
        position_step: (bounds.size() / 65535.0).into(),
        box_min: bounds.min.into(),
        box_max: bounds.max.into(),
        errors: ScoreErrors::default(),
        encoder_id: [7; 32],
    }
}

#[derive(Clone, Debug)]
pub struct SampleShard {
    pub header: ShardHeader,
    pub positions: Vec<[u16; 3]>,
    /// `[K + 1]`.
    pub centroid_starts: Vec<u32>,
    /// `[K][m]`.
    pub centroids: Vec<i8>,
    /// `[K]`.
    pub radii: Vec<f32>,
    /// `[N][dim]`; present in exact shards.
    pub embeddings: Option<Vec<f16>>,
}

impl SampleShard {
    pub fn to_bytes(&self) -> Vec<u8> {
        let input_indices: Vec<u32> = (0..self.header.n_gaussians).collect();
        let exact = |embeddings| ExactColumns { input_indices: &input_indices, embeddings, fine: None };
        let view = ShardView { exact: self.embeddings.as_deref().map(exact), ..self.view() };
        let mut bytes = Vec::new();
        view.write(&mut bytes).expect("writes to memory");
        bytes
    }

    pub fn view(&self) -> ShardView<'_> {
        ShardView {
            header: self.header,
            positions: Positions::Wide(&self.positions),
            centroid_starts: &self.centroid_starts,
            centroids: &self.centroids,
            radii: &self.radii,
            basis: None,
            residuals: None,
            exact: None,
            packed_indices: None,
        }
    }
}

#[derive(Clone, Debug)]
pub struct SampleObject {
    pub id: u64,
    pub position_in_world: DVec3,
    pub bounds: Aabb,
    /// `[n][m]`, in components of the shard's centroids.
    pub vectors: Vec<f32>,
    pub runs: Vec<Range<u32>>,
    pub n_gaussians: u32,
    pub photo: String,
    /// x0, y0, x1, y1.
    pub photo_box_px: [u32; 4],
    /// A JPEG file; empty: none.
    pub thumbnail: Vec<u8>,
}

/// Objects with three vectors each, as scored over a bank of texts.
#[derive(Clone, Debug)]
pub struct SampleObjects {
    pub objects: Vec<SampleObject>,
    pub score_mean: f32,
    pub score_spread: f32,
    pub score_error_bound: f32,
}

impl SampleObjects {
    const N_VECTORS: usize = 3;

    /// Rewrites a shard with these objects, besides other additions.
    pub fn add_to(&self, shard: &ShardView<'_>, others: Additions<'_>) -> Vec<u8> {
        let mut object_of = vec![NO_OBJECT; shard.header.n_gaussians as usize];
        let (mut records, mut vectors, mut steps, mut photos) = (vec![], vec![], vec![], String::new());
        for (number, object) in (0u16..).zip(&self.objects) {
            object.runs.iter().for_each(|run| object_of[run.start as usize..run.end as usize].fill(number));
            records.push(ObjectRecord {
                id: object.id,
                position_in_world: object.position_in_world.into(),
                box_min: object.bounds.min.into(),
                box_max: object.bounds.max.into(),
                n_gaussians: object.n_gaussians,
                n_gaussians_here: object.runs.iter().map(|run| run.len() as u32).sum(),
                photo_box_px: object.photo_box_px,
                photo_start: photos.len() as u32,
                photo_bytes: object.photo.len() as u32,
            });
            photos += &object.photo;
            let m = shard.header.n_components as usize;
            let (components, of_vectors) = quantise_vectors(&object.vectors, m, Self::N_VECTORS);
            vectors.extend(components);
            steps.extend(of_vectors);
        }
        let pictures: Vec<u8> = self.objects.iter().flat_map(|object| object.thumbnail.clone()).collect();
        let ends = self.objects.iter().scan(0, |end, object| {
            *end += object.thumbnail.len() as u32;
            Some(*end)
        });
        let ends: Vec<u32> = ends.collect();
        let (run_ends, run_objects) = collect_runs(object_of);
        let header = ObjectsHeader {
            n_objects: records.len() as u32,
            n_vectors: Self::N_VECTORS as u32,
            n_runs: run_ends.len() as u32,
            photos_bytes: photos.len() as u32,
            score_mean: self.score_mean,
            score_spread: self.score_spread,
            score_error_bound: self.score_error_bound,
        };
        let objects = Objects {
            header,
            records: &records,
            vectors: &vectors,
            steps: &steps,
            run_ends: &run_ends,
            run_objects: &run_objects,
            photos: photos.as_bytes(),
            thumbnails: (!pictures.is_empty()).then_some(Thumbnails { ends: &ends, pictures: &pictures }),
        };
        let mut bytes = Vec::new();
        shard
            .write_with(&mut bytes, Additions { objects: Some(objects), ..others })
            .expect("writes to memory");
        bytes
    }
}

/// Returns a manifest, generation 1, of shards in any profiles, with an unnamed encoder.
pub fn manifest(scene: &str, shards: &[(Profile, &[u8])]) -> Manifest {
    let mut cells: BTreeMap<u32, CellRecord> = BTreeMap::new();
    let mut encoder = encoder();
    for (profile, bytes) in shards {
        let aligned = AlignedBytes::copy_of(bytes);
        let layout = ShardLayout::check(&aligned).expect("a valid shard");
        let (view, header) = (layout.view(&aligned), layout.header);
        (encoder.id, encoder.dim) = (Hash32(header.encoder_id), header.dim);
        let record = ShardRecord {
            hash: Hash32::of(bytes),
            len_bytes: bytes.len() as u64,
            n_centroids: header.n_centroids,
            score_error_bound: view.radii.iter().copied().fold(0.0, f32::max),
            score_errors: header.errors,
            position_error: DVec3::from(header.position_step).max_element() / 2.0,
        };
        let cell = CellRecord {
            cell_id: header.cell_id,
            bounds: view.bounds(),
            n_gaussians: header.n_gaussians,
            shards: BTreeMap::new(),
        };
        cells.entry(header.cell_id).or_insert(cell).shards.insert(*profile, record);
    }
    of_cells(scene, encoder, cells.into_values().collect())
}

/// Returns a manifest of cells whose compact shards have these boxes, hashes and lengths.
pub fn manifest_of(scene: &str, cells: &[(Aabb, Hash32, u64)]) -> Manifest {
    let cell = |(cell_id, (bounds, hash, len_bytes)): (u32, &(Aabb, Hash32, u64))| {
        let record = ShardRecord {
            hash: *hash,
            len_bytes: *len_bytes,
            n_centroids: 1,
            score_error_bound: 0.1,
            score_errors: ScoreErrors::default(),
            position_error: 1e-3,
        };
        let shards = BTreeMap::from([(Profile::Compact, record)]);
        CellRecord { cell_id, bounds: *bounds, n_gaussians: 1, shards }
    };
    of_cells(scene, encoder(), (0..).zip(cells).map(cell).collect())
}

fn encoder() -> EncoderRecord {
    EncoderRecord {
        name: "sample".into(),
        id: Hash32([0; 32]),
        dim: 4,
        default_threshold: 0.1,
        calibration: None,
        text_model: None,
    }
}

fn of_cells(scene: &str, encoder: EncoderRecord, cells: Vec<CellRecord>) -> Manifest {
    Manifest {
        version: manifest::VERSION,
        scene: scene.into(),
        generation: 1,
        created_unix_secs: 1_700_000_000,
        metric: true,
        geo_reference: None,
        encoder,
        n_gaussians: cells.iter().map(|cell| u64::from(cell.n_gaussians)).sum(),
        n_without_evidence: 0,
        n_rejected: 0,
        cells,
    }
}
