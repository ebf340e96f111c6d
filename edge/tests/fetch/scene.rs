//! Small published scenes: a row of cells, 10 wide, along x.

use std::collections::BTreeMap;

use ed25519_dalek::SigningKey;
use glam::DVec3;
use half::f16;
use slag_common::Hash32;
use slag_common::container::AlignedBytes;
use slag_common::frames::{Aabb, GeoReference};
use slag_common::manifest::{self, CellRecord, EncoderRecord, Manifest, ShardRecord, VERSION};
use slag_common::objects::{NO_OBJECT, ObjectRecord, Objects, ObjectsHeader, collect_runs, quantise_vectors};
use slag_common::shard::{
    Additions, ExactColumns, Positions, Profile, ScoreErrors, ShardHeader, ShardLayout, ShardView, quantise,
};
use slag_common::tuf::{
    FileMeta, Key, RoleKeys, Root, Snapshot, TargetFile, Targets, Timestamp, format_utc, sign,
};
use slag_math::random::Random;

pub const DIM: u32 = 4;
pub const ENCODER: Hash32 = Hash32([9; 32]);
pub const NOW: u64 = 1_800_000_000;

/// The keys of a root, by seeds: its own, and that of the other roles.
#[derive(Clone, Copy, Debug)]
pub struct RootKeys {
    pub root: u8,
    pub online: u8,
}

/// The first root of every scene here.
pub const FIRST: RootKeys = RootKeys { root: 1, online: 2 };

pub fn key(seed: u8) -> SigningKey {
    SigningKey::from_bytes(&[seed; 32])
}

/// A scene as a store has it.
#[derive(Clone)]
pub struct Published {
    pub manifest: Manifest,
    /// The manifest's bytes.
    pub listed: Vec<u8>,
    /// Metadata files by name.
    pub metadata: BTreeMap<String, Vec<u8>>,
    pub objects: BTreeMap<Hash32, Vec<u8>>,
}

/// What distinguishes one shard's content from another's.
pub struct ShardSpec {
    pub cell_id: u32,
    pub content: u64,
    pub n_gaussians: u32,
    pub encoder: Hash32,
    pub is_exact: bool,
}

pub fn bounds(cell_id: u32) -> Aabb {
    let min = DVec3::new(f64::from(cell_id) * 10.0, -5.0, 100.0);
    Aabb { min, max: min + DVec3::splat(10.0) }
}

pub fn shard(spec: &ShardSpec) -> Vec<u8> {
    let mut random = Random::new(spec.content ^ u64::from(spec.cell_id) << 32);
    let (n, box_) = (spec.n_gaussians, bounds(spec.cell_id));
    let (centroids, centroid_step) = quantise(&[0.5; DIM as usize]);
    let header = ShardHeader {
        cell_id: spec.cell_id,
        n_gaussians: n,
        n_centroids: 1,
        dim: DIM,
        n_components: DIM,
        n_subspaces: 0,
        position_bits: [16, 16, 16, 0],
        centroid_step,
        origin_in_world: box_.min.into(),
        position_step: [1e-4; 3],
        box_min: box_.min.into(),
        box_max: box_.max.into(),
        errors: ScoreErrors::default(),
        encoder_id: spec.encoder.0,
    };
    let positions: Vec<[u16; 3]> = (0..n).map(|_| [(); 3].map(|()| random.bits() as u16)).collect();
    let indices: Vec<u32> = (0..n).collect();
    let embeddings = vec![f16::from_f32(0.5); (n * DIM) as usize];
    let mut out = Vec::new();
    let exact = ExactColumns { input_indices: &indices, embeddings: &embeddings, fine: None };
    let parts = ShardView {
        header,
        positions: Positions::Wide(&positions),
        centroid_starts: &[0, n],
        centroids: &centroids,
        radii: &[0.1],
        basis: None,
        residuals: None,
        exact: spec.is_exact.then_some(exact),
        packed_indices: None,
    };
    parts.write(&mut out).expect("writes to memory");
    out
}

/// A thing of a scene: an object of one Gaussian.
#[derive(Clone, Copy)]
pub struct TestThing {
    pub cell_id: u32,
    pub id: u64,
    /// Middle of its box, which is 1 wide; y and z are those of the row.
    pub x: f64,
    /// The only axis of its vector.
    pub axis: usize,
}

/// Writes a shard again, with things.
fn with_things(bytes: &[u8], things: &[TestThing]) -> Vec<u8> {
    let bytes = AlignedBytes::copy_of(bytes);
    let layout = ShardLayout::check(&bytes).expect("sound");
    let shard = layout.view(&bytes);
    let mut objects = vec![NO_OBJECT; shard.header.n_gaussians as usize];
    let (mut records, mut vectors, mut steps, mut photos) = (vec![], vec![], vec![], String::new());
    for (at, thing) in things.iter().enumerate() {
        objects[at] = at as u16;
        let middle = DVec3::new(thing.x, 0.0, 105.0);
        let photo = format!("{}.png", thing.id);
        records.push(ObjectRecord {
            id: thing.id,
            position_in_world: middle.into(),
            box_min: (middle - 0.5).into(),
            box_max: (middle + 0.5).into(),
            n_gaussians: 1,
            n_gaussians_here: 1,
            photo_box_px: [0, 0, 1, 1],
            photo_start: photos.len() as u32,
            photo_bytes: photo.len() as u32,
        });
        photos += &photo;
        let vector: Vec<f32> = (0..DIM as usize).map(|axis| f32::from(axis == thing.axis)).collect();
        let (components, of_vectors) = quantise_vectors(&vector, DIM as usize, 2);
        vectors.extend(components);
        steps.extend(of_vectors);
    }
    let (run_ends, run_objects) = collect_runs(objects);
    let header = ObjectsHeader {
        n_objects: records.len() as u32,
        n_vectors: 2,
        n_runs: run_ends.len() as u32,
        photos_bytes: photos.len() as u32,
        score_mean: 0.0,
        score_spread: 0.1,
        score_error_bound: 0.01,
    };
    let objects = Objects {
        header,
        records: &records,
        vectors: &vectors,
        steps: &steps,
        run_ends: &run_ends,
        run_objects: &run_objects,
        photos: photos.as_bytes(),
    };
    let mut out = Vec::new();
    let additions = Additions { objects: Some(&objects), ..Additions::default() };
    shard.write_with(&mut out, additions).expect("writes to memory");
    out
}

impl Published {
    /// Gives every shard the things of its cell.
    pub fn with_things(mut self, things: &[TestThing]) -> Self {
        let mut objects = BTreeMap::new();
        let mut manifest = self.manifest.clone();
        for cell in &mut manifest.cells {
            let is_here = |thing: &&TestThing| thing.cell_id == cell.cell_id;
            let here: Vec<TestThing> = things.iter().filter(is_here).copied().collect();
            for shard in cell.shards.values_mut() {
                let bytes = with_things(&self.objects[&shard.hash], &here);
                (shard.hash, shard.len_bytes) = (Hash32::of(&bytes), bytes.len() as u64);
                objects.insert(shard.hash, bytes);
            }
        }
        self.objects = objects;
        self.edited(|old| *old = manifest)
    }

    /// Publishes cells `0..contents.len()` in both profiles; equal content numbers give equal shards.
    pub fn new(generation: u64, contents: &[u64], n_gaussians: u32) -> Self {
        let mut objects = BTreeMap::new();
        let cells = (0u32..).zip(contents).map(|(cell_id, content)| {
            let shards = [Profile::Compact, Profile::Exact].map(|profile| {
                let is_exact = profile == Profile::Exact;
                let spec = ShardSpec { cell_id, content: *content, n_gaussians, encoder: ENCODER, is_exact };
                let bytes = shard(&spec);
                let (hash, len_bytes) = (Hash32::of(&bytes), bytes.len() as u64);
                objects.insert(hash, bytes);
                let record = ShardRecord {
                    hash,
                    len_bytes,
                    n_centroids: 1,
                    score_error_bound: 0.1,
                    score_errors: ScoreErrors::default(),
                    position_error: 5e-5,
                };
                (profile, record)
            });
            CellRecord { cell_id, bounds: bounds(cell_id), n_gaussians, shards: BTreeMap::from(shards) }
        });
        let manifest = Manifest {
            version: VERSION,
            scene: "yard".into(),
            generation,
            created_unix_secs: NOW - 1000,
            metric: true,
            geo_reference: Some(GeoReference {
                origin: slag_common::frames::Geographic {
                    latitude_deg: 46.8,
                    longitude_deg: -91.9,
                    height_m: 150.0,
                },
            }),
            encoder: EncoderRecord {
                name: "e".into(),
                id: ENCODER,
                dim: DIM,
                default_threshold: 0.1,
                calibration: None,
                text_model: None,
            },
            n_gaussians: u64::from(n_gaussians) * contents.len() as u64,
            n_without_evidence: 0,
            n_rejected: 0,
            cells: cells.collect(),
        };
        let (listed, metadata) = (Vec::new(), BTreeMap::new());
        Self { manifest, listed, metadata, objects }.edited(|_| ())
    }

    /// Changes the manifest and signs it again.
    pub fn edited(mut self, edit: impl FnOnce(&mut Manifest)) -> Self {
        edit(&mut self.manifest);
        self.listed = self.manifest.to_bytes();
        let version = self.manifest.generation;
        self.signed_by(&[FIRST], version)
    }

    /// Signs the metadata again: under the last of these roots, with this version of all other roles.
    pub fn signed_by(mut self, roots: &[RootKeys], version: u64) -> Self {
        self.metadata = metadata(roots, version, NOW + 1000, &self.listed);
        self
    }

    pub fn hash(&self, cell_id: u32, profile: Profile) -> Hash32 {
        self.manifest.cells[cell_id as usize].shards[&profile].hash
    }

    /// Returns the first root.
    pub fn first_root(&self) -> Vec<u8> {
        self.metadata["1.root.json"].clone()
    }

    pub fn bytes(&self, cell_ids: std::ops::Range<u32>) -> u64 {
        cell_ids.map(|id| self.objects[&self.hash(id, Profile::Compact)].len() as u64).sum()
    }
}

/// Returns metadata files by name. Roots are each signed by the one before, too. `expires`: of the timestamp.
pub fn metadata(roots: &[RootKeys], version: u64, expires: u64, target: &[u8]) -> BTreeMap<String, Vec<u8>> {
    let lasting = NOW + 1_000_000;
    let mut files = BTreeMap::new();
    for (at, keys) in roots.iter().enumerate() {
        let (own, before) = (key(keys.root), key(roots[at.saturating_sub(1)].root));
        let bytes = sign(at as u64 + 1, lasting, &root_of(*keys), &[&own, &before]);
        files.insert(format!("{}.root.json", at + 1), bytes);
    }
    let online = key(roots[roots.len() - 1].online);
    let targets = BTreeMap::from([(manifest::TARGET.to_owned(), TargetFile::of(target))]);
    let targets = sign(version, lasting, &Targets { targets, delegations: None }, &[&online]);
    let meta = BTreeMap::from([("targets.json".to_owned(), FileMeta::of(version, &targets))]);
    let snapshot = sign(version, lasting, &Snapshot { meta }, &[&online]);
    let meta = BTreeMap::from([("snapshot.json".to_owned(), FileMeta::of(version, &snapshot))]);
    let timestamp = Timestamp { meta, signed_at: Some(format_utc(NOW - 1000)) };
    files.insert("timestamp.json".to_owned(), sign(version, expires, &timestamp, &[&online]));
    files.insert(format!("{version}.snapshot.json"), snapshot);
    files.insert(format!("{version}.targets.json"), targets);
    files
}

pub fn root_of(seeds: RootKeys) -> Root {
    let [root, online] = [seeds.root, seeds.online].map(|seed| Key::of(&key(seed)));
    let role = |key: &Key| RoleKeys { keyids: vec![key.id()], threshold: 1 };
    let mut roles: BTreeMap<String, RoleKeys> =
        ["targets", "snapshot", "timestamp"].map(|name| (name.to_owned(), role(&online))).into();
    roles.insert("root".to_owned(), role(&root));
    let keys = [root, online].map(|key| (key.id(), key)).into();
    Root { consistent_snapshot: true, keys, roles }
}
