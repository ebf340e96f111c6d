//! The points of a cell, from its exact shard.

use qdrant_client::Payload;
use qdrant_client::qdrant::{GeoPoint, PointStruct};
use slag_common::manifest::{CellRecord, Manifest};
use slag_common::shard::Profile;

use super::PushError;
use crate::store::{StoreReader, StoredShard};

pub(super) struct CellShard {
    stored: StoredShard,
    cell_id: u32,
}

impl CellShard {
    pub(super) fn load(reader: &StoreReader, cell: &CellRecord) -> Result<Self, PushError> {
        let cell_id = cell.cell_id;
        let record = cell.shards.get(&Profile::Exact).ok_or(PushError::NoShard { cell_id })?;
        let stored = reader.read_shard(record)?;
        match stored.view().exact.is_some() {
            true => Ok(Self { stored, cell_id }),
            false => Err(PushError::NoShard { cell_id }),
        }
    }

    /// Returns the number of points: Gaussians that have an embedding.
    pub(super) fn n_points(&self) -> usize {
        self.stored.view().n_with_evidence()
    }

    pub(super) fn n_without_evidence(&self) -> u64 {
        let n_gaussians = self.stored.view().header.n_gaussians;
        u64::from(n_gaussians) - self.n_points() as u64
    }

    /// Builds some of the points, in the shard's order.
    pub(super) fn points(&self, range: std::ops::Range<usize>, manifest: &Manifest) -> Vec<PointStruct> {
        let shard = self.stored.view();
        let Some(exact) = &shard.exact else { return Vec::new() };
        let dim = shard.header.dim as usize;
        let point = |i: usize| {
            let mean = shard.position_in_world(i);
            let mut payload = Payload::with_capacity(7);
            for (axis, value) in [("x", mean.x), ("y", mean.y), ("z", mean.z)] {
                payload.insert(axis, value);
            }
            payload.insert("cell_id", i64::from(self.cell_id));
            payload.insert("scene", manifest.scene.clone());
            payload.insert("generation", generation(manifest));
            if let Some(place) = manifest.geo_reference.map(|place| place.geographic_from_world(mean)) {
                payload.insert("location", GeoPoint { lon: place.longitude_deg, lat: place.latitude_deg });
            }
            let embedding = &exact.embeddings[i * dim..(i + 1) * dim];
            let vector: Vec<f32> = embedding.iter().map(|v| v.to_f32()).collect();
            PointStruct::new(u64::from(exact.input_indices[i]), vector, payload)
        };
        range.map(point).collect()
    }
}

/// Returns the generation as the database's integer type.
pub(super) fn generation(manifest: &Manifest) -> i64 {
    i64::try_from(manifest.generation).unwrap_or(i64::MAX)
}
