//! Small published scenes: a row of cells, 10 wide, along x.

use super::*;

use ed25519_dalek::SigningKey;
use half::f16;
use slag_common::frames::{Aabb, GeoReference, Geographic};
use slag_common::manifest::Manifest;
use slag_common::shard::sample::{self, SampleObject, SampleObjects, SampleShard};
use slag_common::shard::{Additions, ShardHeader, quantise};
use slag_common::tuf::{FileMeta, Key, RoleKeys, Root, Snapshot, Targets, Timestamp, format_utc, sign};

pub const DIM: u32 = 4;
pub const ENCODER: Hash32 = Hash32([9; 32]);
pub const NOW: u64 = 1_800_000_000;

/// The keys of a root, by seeds: its own, and those of the other roles.
#[derive(Clone, Copy, Debug)]
pub struct RootKeys {
    pub root: u8,
    pub online: u8,
}

pub const FIRST: RootKeys = RootKeys { root: 1, online: 2 };

pub fn key(seed: u8) -> SigningKey {
    SigningKey::from_bytes(&[seed; 32])
}

#[derive(Clone)]
pub struct Published {
    pub manifest: Manifest,
    /// The manifest's bytes.
    pub listed: Vec<u8>,
    pub metadata: BTreeMap<String, Vec<u8>>,
    pub objects: BTreeMap<Hash32, Vec<u8>>,
}

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
    let n = spec.n_gaussians as usize;
    let (centroids, centroid_step) = quantise(&[0.5; DIM as usize]);
    let header = sample::header(spec.cell_id, n, 1, DIM as usize, bounds(spec.cell_id));
    let shard = SampleShard {
        header: ShardHeader { centroid_step, encoder_id: spec.encoder.0, ..header },
        positions: (0..n).map(|_| [(); 3].map(|()| random.bits() as u16)).collect(),
        centroid_starts: vec![0, spec.n_gaussians],
        centroids,
        radii: vec![0.1],
        embeddings: spec.is_exact.then(|| vec![f16::from_f32(0.5); n * DIM as usize]),
    };
    shard.to_bytes()
}

/// A thing of a scene: an object of one Gaussian.
#[derive(Clone, Copy)]
pub struct TestThing {
    pub cell_id: u32,
    pub id: u64,
    /// Middle of its box, which is 1 wide; y and z are those of the row.
    pub x: f64,
    pub axis: usize,
}

fn with_things(bytes: &[u8], things: &[TestThing]) -> Vec<u8> {
    let bytes = AlignedBytes::copy_of(bytes);
    let layout = ShardLayout::check(&bytes).expect("sound");
    let object = |(at, thing): (u32, &TestThing)| {
        let middle = DVec3::new(thing.x, 0.0, 105.0);
        SampleObject {
            id: thing.id,
            position_in_world: middle,
            bounds: Aabb { min: middle - 0.5, max: middle + 0.5 },
            vectors: (0..DIM as usize).map(|axis| f32::from(axis == thing.axis)).collect(),
            runs: std::iter::once(at..at + 1).collect(),
            n_gaussians: 1,
            photo: format!("{}.png", thing.id),
            photo_box_px: [0, 0, 1, 1],
            thumbnail: Vec::new(),
        }
    };
    let objects = (0..).zip(things).map(object).collect();
    let objects = SampleObjects { objects, score_mean: 0.0, score_spread: 0.1, score_error_bound: 0.01 };
    objects.add_to(&layout.view(&bytes), Additions::default())
}

impl Published {
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
        let mut shards = Vec::new();
        for (cell_id, content) in (0u32..).zip(contents) {
            for profile in [Profile::Compact, Profile::Exact] {
                let (content, is_exact) = (*content, profile == Profile::Exact);
                let spec = ShardSpec { cell_id, content, n_gaussians, encoder: ENCODER, is_exact };
                shards.push((profile, shard(&spec)));
            }
        }
        let listed: Vec<(Profile, &[u8])> =
            shards.iter().map(|(profile, bytes)| (*profile, &bytes[..])).collect();
        let origin = Geographic { latitude_deg: 46.8, longitude_deg: -91.9, height_m: 150.0 };
        let manifest = Manifest {
            generation,
            created_unix_secs: NOW - 1000,
            geo_reference: Some(GeoReference { origin }),
            ..sample::manifest("yard", &listed)
        };
        let objects = shards.into_iter().map(|(_, bytes)| (Hash32::of(&bytes), bytes)).collect();
        let (listed, metadata) = (Vec::new(), BTreeMap::new());
        Self { manifest, listed, metadata, objects }.edited(|_| ())
    }

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

    pub fn first_root(&self) -> Vec<u8> {
        self.metadata["1.root.json"].clone()
    }

    pub fn bytes(&self, cell_ids: std::ops::Range<u32>) -> u64 {
        cell_ids.map(|id| self.objects[&self.hash(id, Profile::Compact)].len() as u64).sum()
    }
}

/// Returns metadata files by name. Each root is also signed by its predecessor. `expires`: of the timestamp.
fn metadata(roots: &[RootKeys], version: u64, expires: u64, target: &[u8]) -> BTreeMap<String, Vec<u8>> {
    let lasting = NOW + 1_000_000;
    let mut files = BTreeMap::new();
    for (at, keys) in roots.iter().enumerate() {
        let (own, before) = (key(keys.root), key(roots[at.saturating_sub(1)].root));
        let bytes = sign(at as u64 + 1, lasting, &root_of(*keys), &[&own, &before]);
        files.insert(format!("{}.root.json", at + 1), bytes);
    }
    let online = key(roots[roots.len() - 1].online);
    let targets = BTreeMap::from([(manifest::TARGET.to_owned(), TargetFile::of(target))]);
    let targets = sign(version, lasting, &Targets { targets }, &[&online]);
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
