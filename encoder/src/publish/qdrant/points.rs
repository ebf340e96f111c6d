//! Points of a batch.

use qdrant_client::Payload;
use qdrant_client::qdrant::{GeoPoint, PointStruct};
use slag_common::frames::GeoReference;

use super::source::CellVectors;

/// What the payloads of a cell's points have in common.
pub(super) struct CellPayload {
    pub(super) scene: String,
    pub(super) generation: i64,
    pub(super) cell_id: u32,
    pub(super) geo_reference: Option<GeoReference>,
}

/// Builds the points of some vectors of a cell; `dim`: components of an embedding.
pub(super) fn points(
    vectors: &CellVectors,
    range: std::ops::Range<usize>,
    dim: usize,
    cell: &CellPayload,
) -> Vec<PointStruct> {
    let point = |i: usize| {
        let mean = vectors.means_in_world[i];
        let mut payload = Payload::with_capacity(7);
        for (axis, value) in [("x", mean.x), ("y", mean.y), ("z", mean.z)] {
            payload.insert(axis, value);
        }
        payload.insert("cell_id", i64::from(cell.cell_id));
        payload.insert("scene", cell.scene.clone());
        payload.insert("generation", cell.generation);
        if let Some(place) = cell.geo_reference.map(|reference| reference.geographic_from_world(mean)) {
            payload.insert("location", GeoPoint { lon: place.longitude_deg, lat: place.latitude_deg });
        }
        let embedding = &vectors.embeddings[i * dim..(i + 1) * dim];
        let vector: Vec<f32> = embedding.iter().map(|v| v.to_f32()).collect();
        PointStruct::new(u64::from(vectors.input_indices[i]), vector, payload)
    };
    range.map(point).collect()
}
